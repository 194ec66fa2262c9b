"""Reading a LiDAR: bytes in, turns out, against the rate of the serial line."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.report import Aim, Row, number
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Side, Spread, compare
from triform.robots.ldrobot import LD19, PACKET, PacketParser, TurnAssembler, encode_packets
from triform.robots.ldrobot.packets import LINE_RATE, SAMPLES
from triform.threads import limit_threads

#: What a port reads at once: a packet, as the line delivers it, and a full buffer of the system.
READS = (PACKET.itemsize, 4096)


def measure(settings: Settings, watch: Watch) -> Iterator[Row]:
    """Parser and assembler on one thread."""
    stream = _stream(seconds=1 if settings.quick else 10)
    for size in READS:
        reads = [stream[at : at + size] for at in range(0, len(stream), size)]

        def parse(reads: list[bytes] = reads) -> None:
            parser = PacketParser()
            for read in reads:
                parser.feed(read)

        def assemble(reads: list[bytes] = reads) -> None:
            parser, turns = PacketParser(), TurnAssembler(LD19)
            for k, read in enumerate(reads):
                turns.add(parser.feed(read), k * len(read) / LINE_RATE)

        sides = [Side("parser", parse, len(stream)), Side("both", assemble, len(stream))]
        with limit_threads(1):
            seconds = compare(sides, settings, watch, f"LiDAR, reads of {size} bytes")
        ratios = {name: Spread.of(1 / each / LINE_RATE, "x") for name, each in seconds.items()}
        yield Row(
            f"bytes/s of parser and turns over those of the line, reads of {size} bytes, 1 thread",
            ratios["both"],
            Aim(">=", 4),
            {"parser alone": ratios["parser"]},
            f"{number(ratios['both'].median * LINE_RATE / 1e6)} MB/s; a LiDAR takes "
            f"{number(100 / ratios['both'].median)} % of a core.",
        )


def _stream(seconds: float) -> bytes:
    """What an LD19 sends that turns evenly."""
    packets = np.zeros(int(seconds * LD19.samples_per_second / SAMPLES), dtype=PACKET)
    count = np.arange(len(packets))
    packets["speed"] = 360 / LD19.period
    packets["start_angle"] = 960 * count % 36000
    packets["end_angle"] = (960 * count + 880) % 36000
    packets["timestamp"] = 1000 * SAMPLES * count / LD19.samples_per_second % 30000
    packets["samples"]["distance"] = np.random.default_rng(0).integers(0, 12000, (len(packets), SAMPLES))
    return encode_packets(packets)
