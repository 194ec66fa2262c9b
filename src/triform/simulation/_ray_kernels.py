"""Compiled ray casting against oriented boxes, circles and segments.

A ray leaves an observer's centre ``o`` in direction ``d = (cos a, sin a)``. With ``p`` the position of a point
of an obstacle relative to ``o`` and ``x`` the planar cross product, it meets

    a segment p1-p2   at  t = (p1 x (p2 - p1)) / (d x (p2 - p1)),
    a circle (c, rho) at  t = c . d - sqrt(rho^2 - (d x c)^2),

and reports the nearest ``t``. Boxes and circles are solid: a ray that starts inside one measures 0. Walls are
segments without thickness, seen from both sides; one seen exactly end-on is not seen.

``cast_world`` walks, obstacle by obstacle, over the evenly spaced rays of that obstacle's angular interval.
``_moving_ray_kernels`` holds the other way, ray by ray.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit, prange

#: A visible edge spans less than half a turn; more than this share of the turn is an edge-on edge whose
#: two bearings changed places by rounding.
_EDGE_ON = 0.75


@njit(cache=True, nogil=True)
def keep_nearest(row: Any, k: int, distance: float, range_min: float, range_max: float) -> None:
    """Enter a distance [m] into ray ``k`` of a scan unless something nearer is there already."""
    if distance <= range_max:
        if distance < range_min:
            row[k] = -math.inf
        elif distance < row[k]:
            row[k] = distance


@njit(cache=True, nogil=True)
def _cover_all(row: Any, range_min: float, range_max: float) -> None:
    """The observer stands inside an obstacle: every ray measures 0."""
    for k in range(row.shape[0]):
        keep_nearest(row, k, 0.0, range_min, range_max)


@njit(cache=True, nogil=True)
def _ray_index(x: float, y: float, base: float, rays: int) -> float:
    """Fractional index in [0, rays] of the ray that points at (x, y); ``base`` is the first ray's angle."""
    index = (math.atan2(y, x) - base) * (rays / (2 * math.pi))
    return index - math.floor(index / rays) * rays


@njit(cache=True, nogil=True)
def _see_edge(
    x1: float, y1: float, x2: float, y2: float, base: float, range_min: float, range_max: float, row: Any
) -> None:
    """Cast at a segment whose ends, relative to the observer, are in counter-clockwise order around it."""
    rays = row.shape[0]
    ex = x2 - x1
    ey = y2 - y1
    numerator = x1 * ey - y1 * ex
    if numerator <= 0.0:
        return
    start = _ray_index(x1, y1, base, rays)
    stop = _ray_index(x2, y2, base, rays)
    if stop < start:
        if stop + rays - start > _EDGE_ON * rays:
            return
        stop_ray = math.floor(stop) + rays
    else:
        stop_ray = math.floor(stop)
    start_ray = math.ceil(start)
    if stop_ray < start_ray:
        return
    farthest = math.sqrt(max(x1 * x1 + y1 * y1, x2 * x2 + y2 * y2))
    increment = 2 * math.pi / rays
    angle = base + start_ray * increment
    # d x e is a sine of the ray's angle, so it and its quarter-turn partner follow by rotation.
    denominator = math.cos(angle) * ey - math.sin(angle) * ex
    partner = math.cos(angle) * ex + math.sin(angle) * ey
    step_cos = math.cos(increment)
    step_sin = math.sin(increment)
    for step in range(start_ray, stop_ray + 1):
        if denominator > 0.0:
            k = step if step < rays else step - rays
            keep_nearest(row, k, min(numerator / denominator, farthest), range_min, range_max)
        denominator, partner = (
            denominator * step_cos - partner * step_sin,
            partner * step_cos + denominator * step_sin,
        )


@njit(cache=True, nogil=True)
def _see_circle(x: float, y: float, radius: float, base: float, range_min: float, range_max: float, row: Any) -> None:
    """Cast at a circle whose centre is (x, y) relative to the observer."""
    squared = x * x + y * y
    if squared <= radius * radius:
        _cover_all(row, range_min, range_max)
        return
    distance = math.sqrt(squared)
    if distance - radius > range_max:
        return
    rays = row.shape[0]
    increment = 2 * math.pi / rays
    middle = _ray_index(x, y, base, rays)
    half = math.asin(radius / distance) / increment
    start_ray = math.ceil(middle - half)
    angle = base + start_ray * increment
    dx = math.cos(angle)
    dy = math.sin(angle)
    step_cos = math.cos(increment)
    step_sin = math.sin(increment)
    for step in range(start_ray, math.floor(middle + half) + 1):
        across = dx * y - dy * x
        chord = max(0.0, radius * radius - across * across)
        k = step % rays
        keep_nearest(row, k, x * dx + y * dy - math.sqrt(chord), range_min, range_max)
        dx, dy = dx * step_cos - dy * step_sin, dx * step_sin + dy * step_cos


@njit(cache=True, nogil=True)
def _see_box(
    x: float,
    y: float,
    cos: float,
    sin: float,
    half_length: float,
    half_width: float,
    base: float,
    range_min: float,
    range_max: float,
    row: Any,
) -> None:
    """Cast at a box with centre (x, y) relative to the observer and axes turned by (cos, sin)."""
    observer_x = -(x * cos + y * sin)
    observer_y = -(y * cos - x * sin)
    if abs(observer_x) <= half_length and abs(observer_y) <= half_width:
        _cover_all(row, range_min, range_max)
        return
    ux = half_length * cos
    uy = half_length * sin
    vx = -half_width * sin
    vy = half_width * cos
    # Only the one or two sides that face the observer; each is listed clockwise around the box, which is
    # counter-clockwise around an observer outside.
    front_left_x, front_left_y = x + ux + vx, y + uy + vy
    front_right_x, front_right_y = x + ux - vx, y + uy - vy
    rear_left_x, rear_left_y = x - ux + vx, y - uy + vy
    rear_right_x, rear_right_y = x - ux - vx, y - uy - vy
    if observer_x > half_length:
        _see_edge(front_left_x, front_left_y, front_right_x, front_right_y, base, range_min, range_max, row)
    elif observer_x < -half_length:
        _see_edge(rear_right_x, rear_right_y, rear_left_x, rear_left_y, base, range_min, range_max, row)
    if observer_y > half_width:
        _see_edge(rear_left_x, rear_left_y, front_left_x, front_left_y, base, range_min, range_max, row)
    elif observer_y < -half_width:
        _see_edge(front_right_x, front_right_y, rear_right_x, rear_right_y, base, range_min, range_max, row)


@njit(cache=True, nogil=True)
def _see_wall(
    x1: float, y1: float, x2: float, y2: float, base: float, range_min: float, range_max: float, row: Any
) -> None:
    """Cast at a wall given by its ends relative to the observer, in either order."""
    cross = x1 * y2 - y1 * x2
    if cross > 0.0:
        _see_edge(x1, y1, x2, y2, base, range_min, range_max, row)
    elif cross < 0.0:
        _see_edge(x2, y2, x1, y1, base, range_min, range_max, row)
    elif x1 * x2 + y1 * y2 <= 0.0:
        _cover_all(row, range_min, range_max)


@njit(cache=True, nogil=True)
def cast_world(
    poses: Any,
    active: Any,
    half_length: float,
    half_width: float,
    is_circle: bool,
    walls: Any,
    pillars: Any,
    angle_min: float,
    rays: int,
    range_min: float,
    range_max: float,
    out: Any,
) -> None:
    """Cast the instantaneous, noiseless scans of all robots of one world; allocates nothing.

    Args:
        poses: World-frame poses, shape (N, 3) [m, m, rad]; rows of inactive robots are not read.
        active: Which robots exist, shape (N,).
        half_length: Half the footprint along x [m]; the radius of a circle.
        half_width: Half the footprint along y [m]; unused for a circle.
        is_circle: Whether footprints are circles.
        walls: Segments x1, y1, x2, y2, shape (W, 4) [m].
        pillars: Circles x, y, radius, shape (K, 3) [m].
        angle_min: Angle of the first ray in the robot's frame [rad].
        rays: Number of evenly spaced rays of the turn.
        range_min: Nearer returns become ``-inf`` [m].
        range_max: Farther returns become ``+inf`` [m].
        out: Ranges, shape (N, rays), overwritten [m]; ``+inf`` for inactive robots.
    """
    robots = poses.shape[0]
    reach = range_max + (half_length if is_circle else math.hypot(half_length, half_width))
    for i in range(robots):
        row = out[i]
        for k in range(rays):
            row[k] = math.inf
        if not active[i]:
            continue
        x = poses[i, 0]
        y = poses[i, 1]
        base = poses[i, 2] + angle_min
        for j in range(robots):
            if j == i or not active[j]:
                continue
            dx = poses[j, 0] - x
            dy = poses[j, 1] - y
            if dx * dx + dy * dy > reach * reach:
                continue
            if is_circle:
                _see_circle(dx, dy, half_length, base, range_min, range_max, row)
            else:
                cos = math.cos(poses[j, 2])
                sin = math.sin(poses[j, 2])
                _see_box(dx, dy, cos, sin, half_length, half_width, base, range_min, range_max, row)
        for w in range(walls.shape[0]):
            _see_wall(
                walls[w, 0] - x,
                walls[w, 1] - y,
                walls[w, 2] - x,
                walls[w, 3] - y,
                base,
                range_min,
                range_max,
                row,
            )
        for p in range(pillars.shape[0]):
            _see_circle(pillars[p, 0] - x, pillars[p, 1] - y, pillars[p, 2], base, range_min, range_max, row)


@njit(cache=True, nogil=True, parallel=True)
def cast_worlds(
    poses: Any,
    active: Any,
    half_length: float,
    half_width: float,
    is_circle: bool,
    walls: Any,
    pillars: Any,
    angle_min: float,
    rays: int,
    range_min: float,
    range_max: float,
    out: Any,
) -> None:
    """``cast_world`` for B worlds in parallel: every per-robot array gains a leading axis B."""
    for b in prange(poses.shape[0]):
        cast_world(
            poses[b],
            active[b],
            half_length,
            half_width,
            is_circle,
            walls,
            pillars,
            angle_min,
            rays,
            range_min,
            range_max,
            out[b],
        )
