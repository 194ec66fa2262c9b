"""LDROBOT's protocol once more: slow, plain, and sharing nothing with the package."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np


def crc8(data: bytes) -> int:
    """Bit by bit: polynomial 0x4D, initial value 0, most significant bit first."""
    register = 0
    for byte in data:
        for bit in range(7, -1, -1):
            carry = (register >> 7) ^ ((byte >> bit) & 1)
            register = (register << 1) & 0xFF
            if carry:
                register ^= 0x4D
    return register


@dataclass(frozen=True)
class SlowPacket:
    start: int
    speed: int
    start_angle: int
    samples: tuple[tuple[int, int], ...]
    end_angle: int
    timestamp: int


def slow_parse(stream: bytes) -> list[SlowPacket]:
    """The packets of a whole stream, with the index at which each begins."""
    found = []
    at = 0
    while at + 47 <= len(stream):
        packet = stream[at : at + 47]
        if packet[:2] == b"\x54\x2c" and crc8(packet[:46]) == packet[46]:
            speed, start_angle, *values, end_angle, timestamp = struct.unpack("<HH" + "HB" * 12 + "HH", packet[2:46])
            samples = tuple(zip(values[::2], values[1::2], strict=True))
            found.append(SlowPacket(at, speed, start_angle, samples, end_angle, timestamp))
            at += 47
        else:
            at += 1
    return found


def pack(speed: int, start_angle: int, samples: list[tuple[int, int]], end_angle: int, timestamp: int) -> bytes:
    """One packet."""
    values = [value for sample in samples for value in sample]
    body = struct.pack("<BBHH" + "HB" * 12 + "HH", 0x54, 0x2C, speed, start_angle, *values, end_angle, timestamp)
    return body + bytes([crc8(body)])


def slow_turn(samples: list[tuple[float, float]], angles: np.ndarray, reach: float) -> list[set[float]]:
    """Resample one turn: ``samples`` are (angle, range); what each ray may show, nothing where no sample is near."""
    at, metres = np.array(samples).T
    apart = np.abs(np.angle(np.exp(1j * (at - angles[:, None]))))
    limits = np.minimum(reach, apart.min(axis=1) + 1e-9)
    return [set(metres[row <= limit].tolist()) for row, limit in zip(apart, limits, strict=True)]
