"""A LiDAR that is not there: a pseudo-terminal that speaks its packets."""

from __future__ import annotations

import math
import os
from pathlib import Path
from types import TracebackType

import numpy as np

from triform.robots.ldrobot.models import LidarModel
from triform.robots.ldrobot.packets import (
    CLOCK_WRAP,
    FULL_TURN,
    LARGEST_INTENSITY,
    PACKET,
    SAMPLES,
    encode_packets,
    sample_angles,
)
from triform.simulation.mounting import Mounting
from triform.types import FloatArray, RangeArray, TriformError, require

#: Standard deviation of the speed around the usual one, as a share, and how much of it lasts until the next packet.
_SPEED_SPREAD, _SPEED_MEMORY = 0.005, 0.99


class LidarEmulator:
    """Sends what a world measures as a LiDAR would.

    ``due`` asks in which directions it has looked since it was last asked; ``emit`` takes the ranges found there and
    sends all packets that are full. Where nobody reads, bytes are lost as on a serial line.

    Attributes:
        path: What to open in place of a serial port.
    """

    def __init__(
        self, model: LidarModel, rng: np.random.Generator, link: Path | None = None, mounting: Mounting | None = None
    ) -> None:
        """Open a pseudo-terminal.

        Args:
            model: The LiDAR.
            rng: Source of the first angle and time, and of changes of speed.
            link: Where a link to the pseudo-terminal is put, for a name that stays the same; an older link is replaced.
            mounting: How the LiDAR is mounted; upright, its zero forward, if ``None``.

        Raises:
            TriformError: If there is no pseudo-terminal, or the link cannot be made.
        """
        self._model, self._rng, self._mounting = model, rng, mounting or Mounting()
        try:
            # The other end stays open here too, so that readers may come and go.
            # Windows has neither pseudo-terminals nor this module.
            import tty

            self._ends: tuple[int, ...] = os.openpty()
        except OSError as error:
            raise TriformError(f"cannot open a pseudo-terminal: {error.strerror}") from error
        tty.setraw(self._ends[1])
        os.set_blocking(self._ends[0], False)
        terminal = Path(os.ttyname(self._ends[1]))
        self.path = terminal if link is None else link
        if link is not None:
            self._link(link, terminal)
        self._began: float | None = None
        self._issued = 0
        self._boot = float(rng.uniform(0, CLOCK_WRAP))
        self._deviation = 0.0
        self._angle = float(rng.uniform(0, FULL_TURN))
        # Packets whose directions are known; the first sample of the first is number _sent of all.
        self._packets = np.zeros(0, dtype=PACKET)
        self._sent = 0
        self._ranges, self._intensities = np.zeros(0), np.zeros(0)

    def _link(self, link: Path, terminal: Path) -> None:
        try:
            if link.is_symlink():
                link.unlink()
            link.symlink_to(terminal)
        except OSError as error:
            self._close_ends()
            raise TriformError(f"cannot link {link} to a pseudo-terminal: {error.strerror}") from error

    def __enter__(self) -> LidarEmulator:
        """Return the open emulator."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the pseudo-terminal."""
        self.close()

    def due(self, until: float) -> FloatArray:
        """Return the directions of the samples measured since the last call.

        Args:
            until: A moment of any clock [s]; the first call starts the LiDAR.

        Returns:
            Angles in the robot's frame, counter-clockwise, in the order of their measurement, shape (K,) [rad].
        """
        self._began = until if self._began is None else self._began
        done = max(self._issued, int((until - self._began) * self._model.samples_per_second))
        self._turn_on(math.ceil((done - self._sent) / SAMPLES) - len(self._packets))
        angles = sample_angles(self._packets)
        first, self._issued = self._issued, done
        own = np.radians(angles[first - self._sent : done - self._sent])
        return np.asarray(self._mounting.yaw - self._mounting.direction * own)

    def _turn_on(self, count: int) -> None:
        """Make the next ``count`` packets, without their samples."""
        if count <= 0:
            return
        more = np.zeros(count, dtype=PACKET)
        usual = 360 / self._model.period
        innovation = _SPEED_SPREAD * math.sqrt(1 - _SPEED_MEMORY**2)
        for packet, change in zip(more, self._rng.normal(0, innovation, count), strict=True):
            self._deviation = _SPEED_MEMORY * self._deviation + change
            speed = usual * (1 + self._deviation)
            step = 100 * speed / self._model.samples_per_second
            packet["speed"] = round(speed)
            packet["start_angle"] = int(self._angle) % FULL_TURN
            packet["end_angle"] = int(self._angle + (SAMPLES - 1) * step) % FULL_TURN
            self._angle = (self._angle + SAMPLES * step) % FULL_TURN
        lasts = self._sent + SAMPLES * (len(self._packets) + 1 + np.arange(count))
        more["timestamp"] = (self._boot + 1000 * lasts / self._model.samples_per_second) % CLOCK_WRAP
        self._packets = np.concatenate([self._packets, more])

    def emit(self, ranges: RangeArray, intensities: RangeArray) -> None:
        """Send the ranges measured in the directions that ``due`` returned last.

        Args:
            ranges: Ranges [m], shape (K,); what is beyond the LiDAR's reach, and what is no range, becomes a distance
                of 0 as no return does, and what is too close one of 1 mm.
            intensities: How bright these returns are, 0 to 255, shape (K,).

        Raises:
            ConfigurationError: If they are not as many as were due.
        """
        held = self._issued - self._sent - len(self._ranges)
        require(
            ranges.shape == intensities.shape == (held,),
            f"ranges of shape {ranges.shape} and intensities of shape {intensities.shape} given; ({held},) were due",
        )
        self._ranges = np.concatenate([self._ranges, ranges])
        self._intensities = np.concatenate([self._intensities, intensities])
        full = len(self._ranges) // SAMPLES
        if full == 0:
            return
        packets, self._packets = self._packets[:full], self._packets[full:]
        measured, self._ranges = self._ranges[: full * SAMPLES], self._ranges[full * SAMPLES :]
        bright, self._intensities = self._intensities[: full * SAMPLES], self._intensities[full * SAMPLES :]
        self._sent += full * SAMPLES
        near = measured <= self._model.range_max
        metres = np.maximum(np.where(near, measured, 0.0), 0.0)
        levels = np.clip(np.rint(bright), 1, LARGEST_INTENSITY)
        samples = packets["samples"]
        samples["distance"] = np.where(near, np.maximum(np.rint(1000 * metres), 1), 0).reshape(full, SAMPLES)
        samples["intensity"] = np.where(near, levels, 0).reshape(full, SAMPLES)
        self._write(encode_packets(packets))

    def _write(self, data: bytes) -> None:
        """Write what the pseudo-terminal takes; the rest is lost."""
        try:
            os.write(self._ends[0], data)
        except BlockingIOError:
            return

    def close(self) -> None:
        """Close the pseudo-terminal, as if the LiDAR were unplugged, and remove the link."""
        if self.path.is_symlink():
            self.path.unlink()
        self._close_ends()

    def _close_ends(self) -> None:
        ends, self._ends = self._ends, ()
        for end in ends:
            os.close(end)
