"""LDROBOT packets: the parser against a slow one, on any stream cut anyhow."""

from __future__ import annotations

import itertools
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.robots.lidar_oracle import crc8, pack, slow_parse
from triform.robots.ldrobot import PACKET, PacketParser, Packets, encode_packets
from triform.robots.ldrobot.packets import PACKET_BYTES

words = st.integers(0, 0xFFFF)
samples = st.lists(st.tuples(words, st.integers(0, 255)), min_size=12, max_size=12)
packets = st.builds(pack, words, words, samples, words, words)
#: Noise that looks like packets more often than chance would have it.
noise = st.lists(st.sampled_from([b"\x54\x2c", b"\x54", b"\x2c", b"\x00", b"\xff"]) | st.binary(max_size=60)).map(
    b"".join
)


def fields(found: Packets) -> list[tuple[object, ...]]:
    return [
        (p["speed"], p["start_angle"], tuple(map(tuple, p["samples"].tolist())), p["end_angle"], p["timestamp"])
        for p in found
    ]


def feed_in_pieces(parser: PacketParser, stream: bytes, cuts: list[int]) -> Packets:
    bounds = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    return np.concatenate([parser.feed(stream[a:b]) for a, b in itertools.pairwise(bounds)])


def check_against_oracle(stream: bytes, cuts: list[int]) -> None:
    parser = PacketParser()
    found = feed_in_pieces(parser, stream, cuts)
    expected = slow_parse(stream)
    assert fields(found) == [(p.speed, p.start_angle, p.samples, p.end_angle, p.timestamp) for p in expected]
    assert parser.received == len(stream)
    assert parser.packets == len(found)
    assert parser.received == PACKET_BYTES * parser.packets + parser.skipped + parser.pending
    assert parser.pending < PACKET_BYTES


@settings(deadline=None, max_examples=200)
@given(st.lists(st.tuples(noise, packets), max_size=8), noise, st.lists(words, max_size=20))
def test_packets_are_found_between_noise_however_the_stream_is_cut(
    parts: list[tuple[bytes, bytes]], tail: bytes, cuts: list[int]
) -> None:
    check_against_oracle(b"".join(itertools.chain(*parts)) + tail, cuts)


@settings(deadline=None, max_examples=100)
@given(st.lists(packets, min_size=1, max_size=6), st.data())
def test_corrupt_bytes_lose_no_other_packet(good: list[bytes], data: st.DataObject) -> None:
    stream = bytearray(b"".join(good))
    for _ in range(data.draw(st.integers(1, 4))):
        stream[data.draw(st.integers(0, len(stream) - 1))] ^= data.draw(st.integers(1, 255))
    check_against_oracle(bytes(stream), [])
    check_against_oracle(bytes(stream), list(range(len(stream))))


def test_a_packet_inside_a_false_one_is_found() -> None:
    inner = pack(3600, 100, [(1000, 200)] * 12, 980, 7)
    for before in range(2, PACKET_BYTES):
        parser = PacketParser()
        stream = b"\x54\x2c" + b"\x54" * (before - 2) + inner + bytes(PACKET_BYTES)
        assert len(parser.feed(stream)) == 1
        assert parser.crc_errors >= 1
        assert (parser.received, parser.skipped) == (len(stream), len(stream) - PACKET_BYTES)


def test_headers_inside_packets_do_no_harm() -> None:
    distance, intensity = struct.unpack("<HB", b"\x54\x2c\x54")
    stream = pack(0x2C54, 0x2C54, [(distance, intensity)] * 12, 0x2C54, 0x2C54) * 5
    parser = PacketParser()
    assert len(parser.feed(stream)) == 5
    assert (parser.crc_errors, parser.skipped, parser.pending) == (0, 0, 0)


def test_every_flipped_bit_is_noticed() -> None:
    packet = pack(2160, 35000, [(k, k) for k in range(12)], 500, 29999)
    for bit in range(8 * PACKET_BYTES):
        broken = bytearray(packet)
        broken[bit // 8] ^= 1 << bit % 8
        assert len(PacketParser().feed(bytes(broken))) == 0


@settings(deadline=None, max_examples=50)
@given(st.lists(packets, max_size=5))
def test_encoding_is_the_inverse(good: list[bytes]) -> None:
    stream = b"".join(good)
    found = PacketParser().feed(stream)
    assert encode_packets(found) == stream
    blank = found.copy()
    for name in ("header", "kind", "crc"):
        blank[name] = 0
    assert encode_packets(blank) == stream
    assert not blank["crc"].any()


def test_the_checksum_is_that_of_the_data_sheet() -> None:
    assert [crc8(bytes([byte])) for byte in range(4)] == [0x00, 0x4D, 0x9A, 0xD7]
    assert PACKET.itemsize == 47


def test_memory_is_bounded() -> None:
    parser = PacketParser()
    for _ in range(100):
        parser.feed(b"\x54\x2c" * 500)
        assert parser.pending < PACKET_BYTES
    assert parser.crc_errors > 0


@pytest.mark.parametrize("data", [b"", b"\x54", b"\x00" * 46])
def test_too_little_is_no_packet(data: bytes) -> None:
    assert PacketParser().feed(data).shape == (0,)
