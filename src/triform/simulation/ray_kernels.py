"""Compiled ray casting against oriented boxes, circles and segments.

A ray leaves an observer's centre ``o`` in direction ``d = (cos a, sin a)``. With ``p`` the position of a point
of an obstacle relative to ``o`` and ``x`` the planar cross product, it meets

    a segment p1-p2   at  t = (p1 x (p2 - p1)) / (d x (p2 - p1)),
    a circle (c, rho) at  t = c . d - sqrt(rho^2 - (d x c)^2),

and reports the nearest ``t``. Boxes and circles are solid: a ray that starts inside one measures 0. Walls are
segments without thickness, seen from both sides; one seen exactly end-on is not seen.

Obstacles come in the observer's frame, where the rays' directions are the same for everybody, and each is compared with
the rays of its angular interval. ``moving_ray_kernels`` holds the other way, ray by ray.

The innermost loop takes the directions of the rays by themselves, so that it is vectorized.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from triform.kernels import kernel
from triform.simulation.body_kernels import Bodies, body_reach
from triform.types import Body

#: A visible edge spans less than half a turn; more than this share of the turn is an edge-on edge whose
#: two bearings changed places by rounding.
_EDGE_ON = 0.75


class Scene(NamedTuple):
    """What rays meet and robots run into.

    Attributes:
        body: Outline of all robots, ``Body``, or of each, ``Bodies``.
        walls: Segments x1, y1, x2, y2, shape (W, 4) [m].
        pillars: Circles x, y, radius, shape (K, 3) [m].
    """

    body: Body | Bodies
    walls: Any
    pillars: Any


class ScanRays(NamedTuple):
    """The rays of a LiDAR, its limits of range and its place on the base.

    Attributes:
        angle_min: Angle of the first ray in the robot's frame [rad].
        range_min: Nearer returns are ``-inf`` [m].
        range_max: Farther returns are ``+inf`` [m].
        cos: Cosine of every ray's angle, shape (R,).
        sin: Sine of every ray's angle, shape (R,).
        x: Where rays begin, forward of the robot's centre [m].
        y: Where rays begin, left of the robot's centre [m].
    """

    angle_min: float
    range_min: float
    range_max: float
    cos: Any
    sin: Any
    x: float = 0.0
    y: float = 0.0


@kernel
def sight_reach(scan: Any, body: Any) -> float:
    """Distance of two centres beyond which one robot does not see the other [m]."""
    return float(scan.range_max + body_reach(body) + math.hypot(scan.x, scan.y))


@kernel
def keep_nearest(row: Any, k: int, distance: float, range_min: float, range_max: float) -> None:
    """Enter a distance [m] into ray ``k`` of a scan unless something nearer is there already."""
    if distance <= range_max:
        if distance < range_min:
            row[k] = -math.inf
        elif distance < row[k]:
            row[k] = distance


@kernel
def _cover_all(range_min: float, range_max: float, row: Any) -> None:
    """The observer stands inside an obstacle: every ray measures 0."""
    for k in range(row.shape[0]):
        keep_nearest(row, k, 0.0, range_min, range_max)


@kernel(inline="always")
def _ray_index(x: float, y: float, angle_min: float, rays: int) -> float:
    """Fractional index in [0, rays] of the ray that points at (x, y)."""
    index: float = (math.atan2(y, x) - angle_min) * (rays / (2 * math.pi))
    return index - math.floor(index / rays) * rays


@kernel(error_model="numpy")
def _sweep_edge(first: int, last: int, numerator: float, ex: float, ey: float, farthest: float,
    range_min: float, range_max: float, cos_rays: Any, sin_rays: Any, row: Any,
) -> None:  # fmt: skip
    """Compare an edge along (ex, ey) with the rays ``first <= k < last``; branchless, so that it is vectorized."""
    # Unsigned, because signed indices are checked for being counted from the end.
    for k in range(np.uint64(first), np.uint64(last)):
        denominator = cos_rays[k] * ey - sin_rays[k] * ex
        distance = numerator / denominator
        distance = distance if distance < farthest else farthest
        entry = distance if distance >= range_min else -math.inf
        entry = entry if distance <= range_max and denominator > 0.0 else math.inf
        row[k] = entry if entry < row[k] else row[k]


@kernel(inline="always")
def _see_edge(
    x1: float, y1: float, start: float, x2: float, y2: float, stop: float,
    range_min: float, range_max: float, cos_rays: Any, sin_rays: Any, row: Any,
) -> None:  # fmt: skip
    """Cast at a segment whose ends (x1, y1) and (x2, y2) are in counter-clockwise order around the observer [m].

    ``start`` and ``stop`` are the ``_ray_index`` of the two ends.
    """
    rays = row.shape[0]
    ex = x2 - x1
    ey = y2 - y1
    numerator = x1 * ey - y1 * ex
    if numerator <= 0.0:
        return
    first, last = math.ceil(start), math.floor(stop) + 1
    farthest = math.sqrt(max(x1 * x1 + y1 * y1, x2 * x2 + y2 * y2))
    if stop < start:
        if stop + rays - start > _EDGE_ON * rays:
            return
        _sweep_edge(first, rays, numerator, ex, ey, farthest, range_min, range_max, cos_rays, sin_rays, row)
        first = 0
    elif last > rays:
        # An end exactly at a whole turn points along the first ray.
        _sweep_edge(0, 1, numerator, ex, ey, farthest, range_min, range_max, cos_rays, sin_rays, row)
        last = rays
    _sweep_edge(first, last, numerator, ex, ey, farthest, range_min, range_max, cos_rays, sin_rays, row)


@kernel
def see_circle(x: float, y: float, radius: float, scan: Any, row: Any) -> None:
    """Cast at a circle whose centre is (x, y) in the observer's frame."""
    angle_min, range_min, range_max, cos_rays, sin_rays, _, _ = scan
    squared = x * x + y * y
    if squared <= radius * radius:
        _cover_all(range_min, range_max, row)
        return
    distance = math.sqrt(squared)
    if distance - radius > range_max:
        return
    rays = row.shape[0]
    middle = _ray_index(x, y, angle_min, rays)
    half = math.asin(radius / distance) * (rays / (2 * math.pi))
    for step in range(math.ceil(middle - half), math.floor(middle + half) + 1):
        k = step % rays
        across = cos_rays[k] * y - sin_rays[k] * x
        chord = max(0.0, radius * radius - across * across)
        keep_nearest(row, k, x * cos_rays[k] + y * sin_rays[k] - math.sqrt(chord), range_min, range_max)


@kernel
def see_box(x: float, y: float, cos: float, sin: float, body: Any, scan: Any, row: Any) -> None:
    """Cast at a box whose centre is (x, y) in the observer's frame and whose axes are turned by (cos, sin)."""
    half_length, half_width, _ = body
    angle_min, range_min, range_max, cos_rays, sin_rays, _, _ = scan
    observer_x = -(x * cos + y * sin)
    observer_y = -(y * cos - x * sin)
    before = int(observer_x > half_length) - int(observer_x < -half_length)
    beside = int(observer_y > half_width) - int(observer_y < -half_width)
    if before == 0 and beside == 0:
        _cover_all(range_min, range_max, row)
        return
    # Corners are (+-1, +-1), front and left positive. The one or two sides that face the observer are walked
    # clockwise around the box, which is counter-clockwise around an observer outside; the next corner of (a, b) is
    # then (b, -a).
    if before == 0:
        a, b = -beside, beside
    elif beside == 0:
        a, b = before, before
    else:
        a, b = -beside, before
    rays = row.shape[0]
    along_x, along_y = half_length * cos, half_length * sin
    across_x, across_y = -half_width * sin, half_width * cos
    x1, y1 = x + a * along_x + b * across_x, y + a * along_y + b * across_y
    start = _ray_index(x1, y1, angle_min, rays)
    for _ in range(abs(before) + abs(beside)):
        a, b = b, -a
        x2, y2 = x + a * along_x + b * across_x, y + a * along_y + b * across_y
        stop = _ray_index(x2, y2, angle_min, rays)
        _see_edge(x1, y1, start, x2, y2, stop, range_min, range_max, cos_rays, sin_rays, row)
        x1, y1, start = x2, y2, stop


@kernel
def see_wall(x1: float, y1: float, x2: float, y2: float, scan: Any, row: Any) -> None:
    """Cast at a wall given by its ends in the observer's frame, in either order."""
    angle_min, range_min, range_max, cos_rays, sin_rays, _, _ = scan
    rays = row.shape[0]
    cross = x1 * y2 - y1 * x2
    if cross == 0.0:
        if x1 * x2 + y1 * y2 <= 0.0:
            _cover_all(range_min, range_max, row)
        return
    if cross < 0.0:
        x1, y1, x2, y2 = x2, y2, x1, y1
    start, stop = _ray_index(x1, y1, angle_min, rays), _ray_index(x2, y2, angle_min, rays)
    _see_edge(x1, y1, start, x2, y2, stop, range_min, range_max, cos_rays, sin_rays, row)
