"""Fuzz target: any bytes through the parser and the assembler of LDROBOT's LiDARs.

    NUMBA_DISABLE_JIT=1 python -m tests.fuzz.fuzz_lidar FOLDER -max_len=2048 -len_control=0 -max_total_time=60

Random bytes almost never have a right checksum, so an input is a script: noise, good packets, damaged ones, and packets
that go on turning, in reads of any size. Without the compiler the fuzzer sees which lines of the kernels an input
reaches. ``check`` is the whole of it, and runs without the fuzzer too.
"""

from __future__ import annotations

import importlib
import math
import sys
from dataclasses import dataclass

import numpy as np

if __name__ == "__main__":
    import atheris

    with atheris.instrument_imports(include=["triform.robots.ldrobot"]):
        importlib.import_module("triform.robots.ldrobot")

from tests.robots.lidar_oracle import pack, slow_parse
from triform.robots.ldrobot import LD19, LD20, PacketParser, TurnAssembler
from triform.simulation import Mounting
from triform.types import ScanConfig


@dataclass
class Reader:
    """Numbers out of the fuzzer's bytes; zeros after their end."""

    data: bytes
    at: int = 0

    def take(self, count: int) -> bytes:
        piece = self.data[self.at : self.at + count]
        self.at += count
        return piece.ljust(count, b"\0")

    def number(self, count: int) -> int:
        return int.from_bytes(self.take(count), "little")

    @property
    def empty(self) -> bool:
        return self.at >= len(self.data)


def act(script: Reader) -> tuple[bytes, list[int]]:
    """Play a script: the stream, and where reads end."""
    stream, cuts = bytearray(), []
    angle, stamp, speed = 0, 0, 3600
    while not script.empty:
        action = script.number(1)
        if action < 64:
            stream += script.take(action)
        elif action < 96:
            values = [script.number(2) for _ in range(4)]
            stream += pack(values[0], values[1], [(script.number(2), 7)] * 12, values[2], values[3])
        elif action < 112:
            broken = bytearray(pack(speed, angle, [(1000, 100)] * 12, angle, stamp))
            place = script.number(1) % len(broken)
            stream += broken[:place] if action < 104 else broken[:place] + script.take(1) + broken[place + 1 :]
        elif action < 128:
            speed, stamp = script.number(2), script.number(2) % 30000
        elif action < 160:
            cuts.append(len(stream))
        else:
            for _ in range(action - 150):
                end = (angle + speed * 11 // 45) % 36000
                stream += pack(speed, angle, [(script.number(1) * 40, 50)] * 12, end, stamp)
                angle, stamp = (angle + speed * 12 // 45) % 36000, (stamp + 3) % 30000
    return bytes(stream), [*cuts, len(stream)]


def check(data: bytes) -> tuple[int, int]:
    """Play one input and check all that must hold; return the number of bytes fed, and of turns finished."""
    script = Reader(data)
    head = script.number(1)
    model = (LD19, LD20)[head & 1]
    scan = ScanConfig(1 + script.number(1), script.number(1) / 10 - 12, 0.02, 2.0) if head & 2 else None
    assembler = TurnAssembler(
        model, scan, Mounting(yaw=script.number(1) / 20, upright=not head & 8) if head & 4 else None
    )
    stream, cuts = act(script)
    parser, found, arrival, begin, finished = PacketParser(), [], 0.0, 0, 0
    for end in cuts:
        packets = parser.feed(stream[begin:end])
        begin = end
        found += [packet.tobytes() for packet in packets]
        arrival += len(packets) * 12 / model.samples_per_second
        for turn in assembler.add(packets, arrival):
            finished += 1
            assert turn.ranges.shape == (assembler.scan.rays,)
            assert math.isfinite(turn.started)
            assert turn.started <= turn.ended + 0.01
            shown = turn.ranges[np.isfinite(turn.ranges)]
            assert ((shown >= np.float32(0.02)) & (shown <= assembler.scan.range_max)).all()
            assert np.isnan(turn.ranges).mean() <= 0.5
    # The oracle's packets have a right checksum and lie in the stream in this order.
    assert found == [stream[packet.start : packet.start + 47] for packet in slow_parse(stream)]
    assert parser.received == len(stream)
    assert parser.packets == len(found)
    assert parser.received == 47 * parser.packets + parser.skipped + parser.pending
    assert 0 <= parser.pending < 47
    return len(stream), finished


def main() -> None:
    """Fuzz until the fuzzer's own limits end it, and say after each megabyte how much has gone through."""
    executions, fed, turns = 0, 0, 0

    def one_input(data: bytes) -> None:
        nonlocal executions, fed, turns
        more, finished = check(data)
        executions, turns = executions + 1, turns + finished
        if (fed + more) // 1_000_000 > fed // 1_000_000:
            sys.stderr.write(f"{executions} executions, {fed + more} bytes of stream, {turns} turns\n")
        fed += more

    atheris.instrument_func(check)
    atheris.Setup(sys.argv, one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
