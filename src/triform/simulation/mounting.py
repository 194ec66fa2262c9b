"""Where a LiDAR sits on a base, what it cannot see there, and its scans as seen from the centre of the base.

A LiDAR measures from where it is mounted, and part of what it sees may be the robot itself: an arm, a mast, a cable.
Controllers know neither. For them every scan is one of the base's centre, and what only the robot itself can be is
unknown (``NaN``), which is neither a neighbour nor free space.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from triform.kernels import kernel
from triform.types import (
    Body,
    BoolArray,
    ConfigurationError,
    FloatArray,
    RangeArray,
    ScanConfig,
    convert_fields,
    require,
)

#: Neighbouring returns this close to each other are of one surface [m].
_ONE_SURFACE = 0.1
#: What ends nearer to the robot's own outline than this counts as part of the robot [m].
OUTLINE_MARGIN = 0.01


@dataclass(frozen=True)
class Mounting:
    """How a LiDAR is mounted on its base; lengths and angles in the base's frame.

    Attributes:
        x: Forward of the base's centre [m].
        y: Left of the base's centre [m].
        yaw: Direction of the LiDAR's own zero, counter-clockwise [rad].
        upright: Whether it stands upright; one that hangs upside down turns the other way round, seen from above.
        blind_sectors: Directions from the LiDAR in which only the robot itself is, each from one angle
            counter-clockwise to another [deg].
    """

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    upright: bool = True
    blind_sectors: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        convert_fields(self)
        require(
            math.isfinite(self.x) and math.isfinite(self.y),
            f"the LiDAR is mounted at x {self.x} m and y {self.y} m; both must be finite",
        )
        require(math.isfinite(self.yaw), f"the mounting's yaw is {self.yaw} rad; it must be finite")
        for begin, end in self.blind_sectors:
            require(
                math.isfinite(begin) and math.isfinite(end) and begin % 360 != end % 360,
                f"the blind sector {begin:g}:{end:g} is none; it goes counter-clockwise from one angle to another",
            )
        require(not self.blinds(np.radians(np.arange(0, 360, 0.5))).all(), "the blind sectors leave nothing to see")

    @property
    def direction(self) -> int:
        """Sense of the LiDAR's own angles in the base's frame: 1 upright, -1 upside down."""
        return 1 if self.upright else -1

    @property
    def offset(self) -> float:
        """Distance of the LiDAR from the base's centre [m]."""
        return math.hypot(self.x, self.y)

    def blinds(self, angles: FloatArray) -> BoolArray:
        """Tell which directions lie in blind sectors, borders included; angles in the base's frame [rad]."""
        degrees, blind = np.degrees(angles), np.zeros(angles.shape, dtype=np.bool_)
        for begin, end in self.blind_sectors:
            blind |= (degrees - begin) % 360 <= (end - begin) % 360
        return blind


def read_sectors(text: str) -> tuple[tuple[float, float], ...]:
    """Read blind sectors: ``FROM:TO`` in degrees, several separated by spaces.

    Raises:
        ConfigurationError: The text says something else.
    """
    sectors = []
    for word in text.split():
        begin, _, end = word.partition(":")
        try:
            sectors.append((float(begin), float(end)))
        except ValueError:
            raise ConfigurationError(
                f"the blind sector {word!r} is no FROM:TO in degrees, counter-clockwise from the front, such as 170:190"
            ) from None
    return tuple(sectors)


class Placement:
    """Brings turns of one mounted LiDAR into the frame of its base.

    Attributes:
        scan: Rays and limits of range as controllers see them, from the base's centre.
        looks: Rays of the LiDAR outside of blind sectors, shape (R,).
    """

    def __init__(self, scan: ScanConfig, mounting: Mounting | None = None, body: Body | None = None) -> None:
        """Prepare for turns.

        Args:
            scan: Rays of the LiDAR, whose directions are those of the base's frame, and limits of range.
            mounting: Where the LiDAR is; at the base's centre, without blind sectors, if omitted.
            body: Outline of the robot, if what ends within counts as the robot itself.
        """
        self.scan = scan
        self._mounting = mounting or Mounting()
        self._cos, self._sin = np.cos(scan.angles), np.sin(scan.angles)
        self.looks = ~self._mounting.blinds(scan.angles)
        self._own = np.full((2, scan.rays), np.nan) if body is None else self._chords(body)

    def masked(self, ranges: RangeArray) -> RangeArray:
        """Return turns without what is the robot itself: ``NaN`` there.

        Args:
            ranges: Ranges from the LiDAR, up to any reach [m], shape (..., R).
        """
        # What is too close lies at range_min at most.
        distance = np.where(np.isneginf(ranges), self.scan.range_min, ranges)
        own = (self._own[0] <= distance) & (distance <= self._own[1])
        hidden = own | ~self.looks
        return np.where(hidden, ranges.dtype.type(np.nan), ranges) if hidden.any() else ranges

    def from_base(
        self, ranges: RangeArray, intensities: RangeArray | None = None
    ) -> tuple[RangeArray, RangeArray | None]:
        """Return turns as seen from the base's centre, and how bright their returns are.

        Farther than ``scan.range_max`` is ``+inf``. A ray gets the intensity of the return that it gets, and a point
        between two returns that of the nearer one.

        Args:
            ranges: Ranges from the LiDAR, at least ``Mounting.offset`` farther than ``scan.range_max`` [m], shape
                (..., R).
            intensities: Of these returns, in the LiDAR's own scale, of the same shape; ``None`` if not known, and then
                ``None`` is returned.
        """
        if self._mounting.offset == 0:
            far = ranges > self.scan.range_max
            if far.any():
                ranges = np.where(far & (ranges < np.inf), ranges.dtype.type(np.inf), ranges)
            return ranges, intensities
        rows = np.ascontiguousarray(ranges).reshape(-1, self.scan.rays)
        placed = np.empty_like(rows)
        bright = np.zeros((len(rows), 0)) if intensities is None else np.ascontiguousarray(intensities)
        bright = bright.reshape(len(rows), bright.shape[-1])
        shown = np.zeros_like(bright)
        limits = (self.scan.angle_min, self.scan.range_min, self.scan.range_max)
        for row, out, level, level_out in zip(rows, placed, bright, shown, strict=True):
            _see_from_base(
                row, level, self._cos, self._sin, self._mounting.x, self._mounting.y, *limits, out, level_out
            )
        return placed.reshape(ranges.shape), None if intensities is None else shown.reshape(ranges.shape)

    def _chords(self, body: Body) -> FloatArray:
        """Where each ray enters and leaves the outline with its margin, shape (2, R) [m]; ``NaN`` if it misses."""
        x, y = self._mounting.x, self._mounting.y
        if body.is_circle:
            along, across = x * self._cos + y * self._sin, x * self._sin - y * self._cos
            squared = (body.half_length + OUTLINE_MARGIN) ** 2 - across**2
            half = np.sqrt(np.where(squared > 0, squared, np.nan))
            return np.stack([-along - half, -along + half])
        places, along = np.array([[x], [y]]), np.stack([self._cos, self._sin])
        slopes = np.maximum(np.abs(along), 1e-12)
        middles = -places * np.copysign(1.0, along) / slopes
        halves = (np.array([[body.half_length], [body.half_width]]) + OUTLINE_MARGIN) / slopes
        enter, leave = (middles - halves).max(axis=0), (middles + halves).min(axis=0)
        return np.where(enter <= leave, np.stack([enter, leave]), np.nan)


@kernel
def _enter(
    bearing: float, distance: float, level: float, angle_min: float, increment: float, out: Any, levels: Any
) -> None:
    """Enter a return in the ray nearest to its bearing, unless something nearer is there."""
    ray = round((bearing - angle_min) / increment) % out.shape[0]
    if not distance >= out[ray]:
        out[ray] = distance
        if levels.shape[0] > 0:
            levels[ray] = level


@kernel
def _see_from_base(
    ranges: Any, intensities: Any, cos: Any, sin: Any, x: float, y: float, angle_min: float, range_min: float,
    range_max: float, out: Any, levels: Any,
) -> None:  # fmt: skip
    """Write what the centre of the base sees of a scan from (x, y).

    Every return is entered in the nearest ray of the base, and between two returns of one surface so are points of the
    line that joins them. A ray without any is free, or unknown if the LiDAR knows nothing about where it ends.
    Intensities and ``levels`` have shape (R,), or (0,) where they are not known; ``levels`` must come filled with 0.
    """
    rays = ranges.shape[0]
    bright = intensities.shape[0] > 0
    increment = 2 * math.pi / rays
    for k in range(rays):
        bearing = math.atan2(range_max * sin[k] - y, range_max * cos[k] - x)
        towards = round((bearing - angle_min) / increment) % rays
        out[k] = math.nan if math.isnan(ranges[towards]) else math.inf
    before_x = before_y = math.inf
    before_level = level = 0.0
    for step in range(rays + 1):
        k = step % rays
        distance = range_min if ranges[k] == -math.inf else ranges[k]
        if not distance < math.inf:
            before_x = before_y = math.inf
            continue
        if bright:
            level = intensities[k]
        here_x, here_y = x + distance * cos[k], y + distance * sin[k]
        from_base, bearing = math.hypot(here_x, here_y), math.atan2(here_y, here_x)
        if from_base <= range_max:
            entry = -math.inf if ranges[k] == -math.inf else from_base
            _enter(bearing, entry, level, angle_min, increment, out, levels)
        if math.hypot(here_x - before_x, here_y - before_y) <= _ONE_SURFACE:
            turn = math.atan2(before_y, before_x) - bearing
            turn -= 2 * math.pi * math.floor(turn / (2 * math.pi) + 0.5)
            parts = int(abs(turn) / increment) + 1
            for part in range(1, parts):
                share = part / parts
                point_x, point_y = here_x + share * (before_x - here_x), here_y + share * (before_y - here_y)
                between = math.hypot(point_x, point_y)
                if between <= range_max:
                    nearer = level if share <= 0.5 else before_level
                    _enter(math.atan2(point_y, point_x), between, nearer, angle_min, increment, out, levels)
        before_x, before_y, before_level = here_x, here_y, level
