"""The packets of LDROBOT's LiDARs, found in and written to a stream of bytes.

A packet is 47 bytes, little-endian, and holds twelve samples. Two bytes begin it and a checksum ends it, but both also
occur inside packets and in noise. So every place that begins like a packet is tried, in order, and taken if the
checksum is right; otherwise the search goes on with the very next byte, and no packet that begins inside a false one is
lost. A false beginning has a right checksum by chance once in 256 times.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from triform.kernels import kernel
from triform.types import FloatArray

#: Speed of the serial line [baud]; ten bits carry a byte (8N1).
BAUD = 230400
#: Bytes per second that the line carries.
LINE_RATE = BAUD / 10
HEADER = 0x54
#: Type of the packet in the upper three bits, number of samples in the lower five.
KIND = 0x2C
SAMPLES = 12
#: The clock of the LiDAR starts again at this number [ms].
CLOCK_WRAP = 30000
#: One packet as it is on the line: rate of rotation [deg/s], angles of the first and the last sample [0.01 deg]
#: (clockwise), samples (distance [mm], 0 for no return; intensity, 0 to 255), and the time at which it was made [ms].
PACKET = np.dtype(
    [
        ("header", "u1"),
        ("kind", "u1"),
        ("speed", "<u2"),
        ("start_angle", "<u2"),
        ("samples", [("distance", "<u2"), ("intensity", "u1")], (SAMPLES,)),
        ("end_angle", "<u2"),
        ("timestamp", "<u2"),
        ("crc", "u1"),
    ]
)
PACKET_BYTES = PACKET.itemsize
#: Brightest return that a packet can tell.
LARGEST_INTENSITY = 255
#: A full turn in the packets' angles.
FULL_TURN = 36000
#: Arrays of ``PACKET``, shape (K,).
Packets = NDArray[np.void]

_POLYNOMIAL = 0x4D


def _checksum_table() -> NDArray[np.uint8]:
    """Checksum of every single byte."""
    crc = np.arange(256)
    for _ in range(8):
        crc = (crc << 1) ^ np.where(crc & 0x80, 0x100 | _POLYNOMIAL, 0)
    return crc.astype(np.uint8)


_TABLE = _checksum_table()


@kernel
def _checksum(stream: Any, first: int, table: Any) -> int:
    """Checksum of the packet that begins at ``first``: all its bytes but the last."""
    crc = 0
    for k in range(first, first + PACKET_BYTES - 1):
        crc = table[crc ^ stream[k]]
    return crc


@kernel
def _find_into(stream: Any, table: Any, starts: Any) -> tuple[int, int, int]:
    """Fill ``starts`` with where packets begin; return their number, that of wrong checksums, and the bytes done."""
    end = stream.shape[0]
    at, found, wrong = 0, 0, 0
    while at < end:
        if stream[at] != HEADER or (at + 1 < end and stream[at + 1] != KIND):
            at += 1
        elif at + PACKET_BYTES > end:
            break
        elif _checksum(stream, at, table) == stream[at + PACKET_BYTES - 1]:
            starts[found] = at
            found += 1
            at += PACKET_BYTES
        else:
            wrong += 1
            at += 1
    return found, wrong, at


class PacketParser:
    """Finds packets in a stream that arrives in pieces; how it is cut makes no difference.

    Attributes:
        received: Bytes fed.
        packets: Packets found.
        crc_errors: Places that begin like a packet but whose checksum is wrong.
        skipped: Bytes that belong to no packet. ``received`` is ``PACKET_BYTES * packets + skipped + pending``.
    """

    def __init__(self) -> None:
        self.received = 0
        self.packets = 0
        self.crc_errors = 0
        self.skipped = 0
        self._tail = b""

    @property
    def pending(self) -> int:
        """Bytes that may belong to a packet whose end has not come yet; always fewer than a packet."""
        return len(self._tail)

    def feed(self, data: bytes) -> Packets:
        """Take the next bytes of the stream and return the packets that they complete, in order, shape (K,)."""
        stream = np.frombuffer(self._tail + data, dtype=np.uint8)
        starts = np.empty(len(stream) // PACKET_BYTES, dtype=np.int64)
        found, wrong, done = _find_into(stream, _TABLE, starts)
        self._tail = stream[done:].tobytes()
        self.received += len(data)
        self.packets += found
        self.crc_errors += wrong
        self.skipped += done - found * PACKET_BYTES
        rows = stream[starts[:found, None] + np.arange(PACKET_BYTES)]
        return np.asarray(rows.view(PACKET)[:, 0])


def sample_angles(packets: Packets) -> FloatArray:
    """Directions of all samples of packets, shape (K,), on the LiDAR's own clockwise circle [deg], shape (12 K,)."""
    starts = packets["start_angle"].astype(np.int64)
    steps = (packets["end_angle"] - starts) % FULL_TURN / (SAMPLES - 1)
    return np.asarray((starts[:, None] + steps[:, None] * np.arange(SAMPLES)).ravel() / 100)


def encode_packets(packets: Packets) -> bytes:
    """Return packets as they are on the line.

    Args:
        packets: Packets, shape (K,); the first two bytes and the checksum of each are filled in.
    """
    whole = packets.copy()
    whole["header"], whole["kind"] = HEADER, KIND
    stream = np.frombuffer(whole.tobytes(), dtype=np.uint8)
    whole["crc"] = [_checksum(stream, first, _TABLE) for first in range(0, len(stream), PACKET_BYTES)]
    return whole.tobytes()
