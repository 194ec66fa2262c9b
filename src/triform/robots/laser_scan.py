"""Turns of LiDARs, and scans of any that speaks ``sensor_msgs/LaserScan``, brought onto a fixed grid."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from triform.simulation.mounting import Mounting
from triform.types import RangeArray, ScanConfig, require

#: Share of a ray by which angles may be off: they come as float32, and a turn has many rays.
_SLACK = 0.01


@dataclass(frozen=True)
class Turn:
    """One turn of a LiDAR, on a fixed grid of rays.

    Attributes:
        ranges: Ranges [m], float32, shape (R,); REP 117 for what is no range.
        started: When the first ray was measured, by the host's monotonic clock [s].
        ended: When the last ray was measured, by the same clock [s].
        intensities: How bright every return is, in the LiDAR's own scale, float32, shape (R,); ``None`` where it does
            not say.
    """

    ranges: RangeArray
    started: float
    ended: float
    intensities: RangeArray | None = None


@dataclass(frozen=True)
class LaserScan:
    """One scan as its driver tells it: clockwise or counter-clockwise, from any angle, a turn or a part of one.

    Attributes:
        ranges: Measured ranges [m], any number.
        angle_min: Angle of the first ray [rad].
        angle_max: Angle of the last ray [rad]; drivers are off by one ray at times, and that is accepted.
        angle_increment: From one ray to the next [rad]; negative for a LiDAR that turns clockwise.
        range_min: Nearer ranges are not measurements [m].
        range_max: Farther ranges are not measurements [m].
        intensities: How bright every return is, in the LiDAR's own scale, as many as ranges; ``None`` or none where
            the driver does not say.
    """

    ranges: RangeArray
    angle_min: float
    angle_max: float
    angle_increment: float
    range_min: float
    range_max: float
    intensities: RangeArray | None = None

    def __post_init__(self) -> None:
        rays, step = len(self.ranges), abs(self.angle_increment)
        bright = 0 if self.intensities is None else len(self.intensities)
        require(bright in (0, rays), f"the scan has {bright} intensities and {rays} ranges; it needs as many, or none")
        for name in ("angle_min", "angle_max", "angle_increment"):
            require(math.isfinite(getattr(self, name)), f"{name} is {getattr(self, name)}; it must be finite")
        require(step > 0, "angle_increment is 0; it must be the angle between neighbouring rays")
        require(rays >= 2, f"the scan has {rays} rays; at least 2 are needed")
        last = self.angle_min + (rays - 1) * self.angle_increment
        require(
            abs(last - self.angle_max) <= 1.5 * step,
            f"{rays} rays from {self.angle_min:.3f} rad on, each {self.angle_increment:.5f} rad further, end at "
            f"{last:.3f} rad and not at angle_max {self.angle_max:.3f} rad",
        )
        require(
            (rays - 1) * step <= 2 * math.pi + step / 2,
            f"{rays} rays with {step:.5f} rad in between are more than a full turn",
        )
        require(
            0 <= self.range_min < self.range_max,
            f"range_min {self.range_min} m and range_max {self.range_max} m must satisfy 0 <= range_min < range_max",
        )

    @property
    def coverage(self) -> float:
        """Share of a full turn that the rays cover."""
        return min(1.0, len(self.ranges) * abs(self.angle_increment) / (2 * math.pi))

    def mounted(self, mounting: Mounting) -> LaserScan:
        """Return the scan of a mounted LiDAR with the directions that its rays have in the base's frame."""
        first, last = (mounting.yaw + mounting.direction * angle for angle in (self.angle_min, self.angle_max))
        step = mounting.direction * self.angle_increment
        return replace(self, angle_min=first, angle_max=last, angle_increment=step)

    def on_grid(self, grid: ScanConfig) -> RangeArray:
        """Give every ray of the grid the range of the measured ray that is nearest in angle.

        What is not finite stays as it is (REP 117). Below ``range_min``, the scan's or the grid's, is ``-inf``, and
        above the scan's ``range_max`` ``+inf``; returns from beyond the grid's are kept, because they show that the
        LiDAR measures. Zero or less, which many drivers write for "nothing valid", is ``NaN``, and so is a ray of the
        grid that is farther from all measured ones than half the larger of both spacings: a part of the turn that the
        LiDAR does not see is not free, it is unknown.

        Args:
            grid: The full turn that is wanted, in the same frame.

        Returns:
            Ranges on the grid, float32, shape (R,) [m].

        Raises:
            ConfigurationError: The LiDAR does not reach as far as the grid, or its rays lie more than twice as far
                apart.
        """
        require(
            self.range_max >= grid.range_max - 1e-3,
            f"the scan reaches {self.range_max:g} m; {grid.range_max:g} m are needed",
        )
        step = abs(self.angle_increment)
        require(
            step <= 2 * grid.angle_increment * (1 + _SLACK),
            f"rays lie {step:.4f} rad apart; at most twice the {grid.angle_increment:.4f} rad of a grid of "
            f"{grid.rays} rays are allowed",
        )
        nearest, distance = self._nearest(grid)
        measured = np.asarray(self.ranges, dtype=np.float32)[nearest]
        near = max(self.range_min, grid.range_min)
        placed = np.where(measured > self.range_max, np.float32(np.inf), measured)
        placed[(measured > 0) & (measured < near)] = -np.inf
        unseen = distance > 0.5 * max(1.0, grid.angle_increment / step) + _SLACK
        placed[unseen | ((measured <= 0) & (measured > -np.inf))] = np.nan
        return placed

    def intensities_on_grid(self, grid: ScanConfig) -> RangeArray | None:
        """Give every ray of the grid the intensity of the measured ray whose range it gets from ``on_grid``.

        Args:
            grid: The full turn that is wanted, in the same frame.

        Returns:
            Intensities on the grid, float32, shape (R,); ``None`` where the driver does not say.
        """
        if self.intensities is None or len(self.intensities) == 0:
            return None
        on_grid: RangeArray = np.asarray(self.intensities, dtype=np.float32)[self._nearest(grid)[0]]
        return on_grid

    def _nearest(self, grid: ScanConfig) -> tuple[np.ndarray, np.ndarray]:
        """Measured ray nearest to every ray of the grid, and how far it is, in spacings of the scan; shapes (R,)."""
        rays, turn = len(self.ranges), 2 * math.pi / abs(self.angle_increment)
        place = ((grid.angles - self.angle_min) / self.angle_increment) % turn
        ray = np.rint(place)
        beyond = ray > rays - 1
        # Behind the last ray comes, after a gap or at once, the first one.
        ray[beyond] = np.where(turn - place[beyond] < place[beyond] - (rays - 1), 0, rays - 1)
        distance = np.abs(place - ray)
        return ray.astype(np.intp), np.minimum(distance, turn - distance)
