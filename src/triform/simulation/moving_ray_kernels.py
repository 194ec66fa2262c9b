"""Compiled ray casting ray by ray, for rays at perturbed angles or at different moments.

Equations and conventions are those of ``ray_kernels``, which is some 20 times faster where all rays are evenly
spaced and measured at once.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from triform.geometry.cells import pairs_within
from triform.kernels import kernel
from triform.simulation.body_kernels import body_of, body_reach
from triform.simulation.ray_kernels import sight_reach

#: What a ray has hit that hits nothing.
HIT_NOTHING = -1
#: Of a robot that touches an obstacle, rays hit the obstacle from so near on [m].
SAME_PLACE = 1e-9


class DueRays(NamedTuple):
    """Rays that are cast one after the other while robots move.

    Attributes:
        robot: The first robot that casts; the others follow it.
        first: First ray to cast.
        last: One past the last ray to cast.
        first_share: Share of the way at which the first ray is cast.
        share_step: Share of the way between two rays; 0 casts all at one moment.
    """

    robot: int
    first: int
    last: int
    first_share: float
    share_step: float


@kernel
def _distance_to_circle(x: float, y: float, radius: float, dx: float, dy: float) -> float:
    across = dx * y - dy * x
    along = dx * x + dy * y
    if x * x + y * y <= radius * radius:
        return 0.0
    if along <= 0.0 or abs(across) > radius:
        return math.inf
    return along - math.sqrt(radius * radius - across * across)


@kernel
def _distance_to_box(
    x: float, y: float, cos: float, sin: float, half_length: float, half_width: float, dx: float, dy: float
) -> float:
    """Slab method in the box's own frame."""
    nearest = 0.0
    farthest = math.inf
    for axis in range(2):
        if axis == 0:
            origin = -(x * cos + y * sin)
            slope = dx * cos + dy * sin
            half = half_length
        else:
            origin = -(y * cos - x * sin)
            slope = dy * cos - dx * sin
            half = half_width
        if slope == 0.0:
            if abs(origin) > half:
                return math.inf
            continue
        first = (-half - origin) / slope
        second = (half - origin) / slope
        nearest = max(nearest, min(first, second))
        farthest = min(farthest, max(first, second))
    return nearest if nearest <= farthest else math.inf


@kernel
def _distance_to_wall(x1: float, y1: float, x2: float, y2: float, dx: float, dy: float) -> float:
    ex = x2 - x1
    ey = y2 - y1
    denominator = dx * ey - dy * ex
    if denominator == 0.0:
        return math.inf
    along = (x1 * ey - y1 * ex) / denominator
    share = (x1 * dy - y1 * dx) / denominator
    return along if along >= 0.0 and 0.0 <= share <= 1.0 else math.inf


@kernel
def list_near(poses: Any, active: Any, distance: float) -> tuple[Any, Any]:
    """List for every robot the others within ``distance`` [m], whatever the number of robots.

    Returns:
        Offsets of shape (N + 1,) and robots: those near to robot i are ``robots[offsets[i] : offsets[i + 1]]``.
    """
    pairs = pairs_within(poses, active, distance * distance)
    offsets = np.zeros(active.shape[0] + 1, dtype=np.int64)
    for pair in range(pairs.shape[0]):
        offsets[pairs[pair, 0] + 1] += 1
        offsets[pairs[pair, 1] + 1] += 1
    for i in range(active.shape[0]):
        offsets[i + 1] += offsets[i]
    filled = offsets[:-1].copy()
    robots = np.empty(2 * pairs.shape[0], dtype=np.int64)
    for pair in range(pairs.shape[0]):
        for side in range(2):
            i = pairs[pair, side]
            robots[filled[i]] = pairs[pair, 1 - side]
            filled[i] += 1
    return offsets, robots


@kernel(inline="always")
def _nearest_along(
    x: float, y: float, dx: float, dy: float, places: Any, first: int, last: int, near: Any, around: float, scene: Any
) -> float:
    """Distance from (x, y) to the nearest obstacle in direction (dx, dy) [m]."""
    nearest = math.inf
    body, walls, pillars = scene
    for k in range(first, last):
        j = near[k]
        ox = places[j, 0] - x
        oy = places[j, 1] - y
        if abs(dx * oy - dy * ox) > around or dx * ox + dy * oy < -around:
            continue
        half_length, half_width, is_circle = body_of(body, j)
        if is_circle:
            found = _distance_to_circle(ox, oy, half_length, dx, dy)
        else:
            found = _distance_to_box(ox, oy, places[j, 3], places[j, 4], half_length, half_width, dx, dy)
        nearest = min(nearest, found)
    for w in range(walls.shape[0]):
        found = _distance_to_wall(walls[w, 0] - x, walls[w, 1] - y, walls[w, 2] - x, walls[w, 3] - y, dx, dy)
        nearest = min(nearest, found)
    for p in range(pillars.shape[0]):
        found = _distance_to_circle(pillars[p, 0] - x, pillars[p, 1] - y, pillars[p, 2], dx, dy)
        nearest = min(nearest, found)
    return nearest


@kernel
def _which_along(x: float, y: float, dx: float, dy: float, distance: float, walls: Any, pillars: Any) -> int:
    """What is hit at a distance [m] from (x, y) in direction (dx, dy), as ``hits`` of ``cast_moving``."""
    hit: int = walls.shape[0] + pillars.shape[0]
    nearest = distance + SAME_PLACE
    for w in range(walls.shape[0]):
        found = _distance_to_wall(walls[w, 0] - x, walls[w, 1] - y, walls[w, 2] - x, walls[w, 3] - y, dx, dy)
        if found < nearest:
            nearest, hit = found, w
    for p in range(pillars.shape[0]):
        found = _distance_to_circle(pillars[p, 0] - x, pillars[p, 1] - y, pillars[p, 2], dx, dy)
        if found < nearest:
            nearest, hit = found, walls.shape[0] + p
    return hit


@kernel
def cast_moving(
    start: Any, end: Any, active: Any, near: Any, scene: Any, scan: Any, offsets: Any, due: Any, out: Any, hits: Any
) -> None:
    """Cast rays ``due.first <= k < due.last`` of one world while its robots move from ``start`` to ``end``.

    Ray k is cast with every pose at the share ``first_share + (k - first) * share_step`` of the way (positions linear,
    headings along the shorter turn), at the angle of ray k plus ``offsets[i, k]``.

    Args:
        start: Poses at share 0, shape (N, 3) [m, m, rad].
        end: Poses at share 1, shape (N, 3) [m, m, rad].
        active: Which robots exist, shape (N,).
        near: Whom each robot may see, as ``list_near`` returns it.
        scene: ``Scene``.
        scan: ``ScanRays``.
        offsets: Error of every ray's angle, shape (M, R) [rad], or (M, 0) for none.
        due: ``DueRays``.
        out: Ranges of the M robots that cast, shape (M, R); only the rays cast and only active robots are written [m].
        hits: What these rays hit, shape (M, R), or (M, 0) if not asked for: the index of a wall, the number of walls
            plus that of a pillar, the number of both for any robot, and ``HIT_NOTHING``.
    """
    robots = start.shape[0]
    increment = 2 * math.pi / out.shape[1]
    places = np.empty((robots, 5))
    angle_min, range_min, range_max = scan.angle_min, scan.range_min, scan.range_max
    first_robot, first_ray, last_ray, first_share, share_step = due
    ends, others = near
    around = body_reach(scene.body)
    for k in range(first_ray, last_ray):
        if k == first_ray or share_step != 0.0:
            share = min(max(first_share + (k - first_ray) * share_step, 0.0), 1.0)
            for i in range(robots):
                if active[i]:
                    turn = end[i, 2] - start[i, 2]
                    turn -= 2 * math.pi * math.floor(turn / (2 * math.pi) + 0.5)
                    heading = start[i, 2] + share * turn
                    places[i, 0] = start[i, 0] + share * (end[i, 0] - start[i, 0])
                    places[i, 1] = start[i, 1] + share * (end[i, 1] - start[i, 1])
                    places[i, 2] = heading
                    places[i, 3] = math.cos(heading)
                    places[i, 4] = math.sin(heading)
        for m in range(out.shape[0]):
            # Unsigned, because signed indices are checked for being counted from the end.
            own = np.uint64(first_robot + m)
            if not active[own]:
                continue
            angle = places[own, 2] + angle_min + k * increment
            if offsets.shape[1] > 0:
                angle += offsets[m, k]
            x, y = places[own, 0], places[own, 1]
            if scan.x != 0.0 or scan.y != 0.0:
                x += places[own, 3] * scan.x - places[own, 4] * scan.y
                y += places[own, 4] * scan.x + places[own, 3] * scan.y
            dx, dy = math.cos(angle), math.sin(angle)
            found = _nearest_along(x, y, dx, dy, places, ends[own], ends[own + np.uint64(1)], others, around, scene)
            # As ``keep_nearest`` into an empty ray; rows of ``out`` are not taken, which costs in an inner loop.
            out[m, k] = math.inf if found > range_max else -math.inf if found < range_min else found
            if hits.shape[1] > 0:
                hits[m, k] = HIT_NOTHING
                if found <= range_max:
                    hits[m, k] = _which_along(x, y, dx, dy, found, scene.walls, scene.pillars)


@kernel
def cast_moving_worlds(
    start: Any, end: Any, active: Any, scene: Any, scan: Any, offsets: Any, share_step: float, robot: int, out: Any,
    hits: Any,
    first: int, last: int,
) -> None:  # fmt: skip
    """``cast_moving`` of whole turns for the worlds ``first <= b < last``; ``out`` must come filled with ``+inf``.

    The robots from ``robot`` on cast.
    """
    for b in range(first, last):
        travel = 0.0
        for i in range(active.shape[1]):
            if active[b, i]:
                travel = max(travel, math.hypot(end[b, i, 0] - start[b, i, 0], end[b, i, 1] - start[b, i, 1]))
        near = list_near(start[b], active[b], seen_within(scene.body, scan, travel))
        due = DueRays(robot, 0, out.shape[2], 0.0, share_step)
        cast_moving(start[b], end[b], active[b], near, scene, scan, offsets[b], due, out[b], hits[b])


@kernel
def seen_within(body: Any, scan: Any, travel: float) -> float:
    """Distance of two centres [m] beyond which robots cannot see each other before both have gone ``travel`` [m]."""
    return float((sight_reach(scan, body) + 2 * travel) * (1 + 1e-9))
