"""Compiled overlap tests between footprints, walls and pillars. Touching is no overlap."""

from __future__ import annotations

import math
from typing import Any

from triform.kernels import kernel
from triform.simulation.body_kernels import body_of


@kernel
def _axis_separates(dx: float, dy: float, cos: float, sin: float, own: Any, other: Any) -> bool:
    """Whether an axis of a box separates it from another at (dx, dy), turned by (cos, sin), in its own frame."""
    cos, sin = abs(cos), abs(sin)
    return bool(
        abs(dx) >= own.half_length + other.half_length * cos + other.half_width * sin
        or abs(dy) >= own.half_width + other.half_length * sin + other.half_width * cos
    )


@kernel
def _box_overlaps_circle(dx: float, dy: float, cos: float, sin: float, box: Any, radius: float) -> bool:
    """Whether a box with the heading (cos, sin) overlaps a circle whose centre is at (dx, dy) from its own."""
    outside_x = max(abs(cos * dx + sin * dy) - box.half_length, 0.0)
    outside_y = max(abs(cos * dy - sin * dx) - box.half_width, 0.0)
    return bool(math.hypot(outside_x, outside_y) < radius)


@kernel
def robots_overlap(poses: Any, i: int, j: int, body: Any) -> bool:
    """Whether the footprints of robots i and j, poses of shape (N, 3), overlap (of boxes, separating axis test).

    ``body`` is the ``Body`` of all robots or the ``Bodies`` of each.
    """
    first, second = body_of(body, i), body_of(body, j)
    dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
    squared = dx * dx + dy * dy
    if first.is_circle and second.is_circle:
        reach = first.half_length + second.half_length
        return bool(squared < reach * reach)
    if first.is_circle:
        return bool(
            _box_overlaps_circle(-dx, -dy, math.cos(poses[j, 2]), math.sin(poses[j, 2]), second, first.half_length)
        )
    if second.is_circle:
        return bool(
            _box_overlaps_circle(dx, dy, math.cos(poses[i, 2]), math.sin(poses[i, 2]), first, second.half_length)
        )
    # No less than the square of the sum of their circumradii.
    corners = first.half_length**2 + first.half_width**2 + (second.half_length**2 + second.half_width**2)
    if squared >= 2 * corners:
        return False
    cos1, sin1 = math.cos(poses[i, 2]), math.sin(poses[i, 2])
    cos2, sin2 = math.cos(poses[j, 2]), math.sin(poses[j, 2])
    cos, sin = cos1 * cos2 + sin1 * sin2, cos1 * sin2 - sin1 * cos2
    if _axis_separates(cos1 * dx + sin1 * dy, cos1 * dy - sin1 * dx, cos, sin, first, second):
        return False
    return not _axis_separates(cos2 * dx + sin2 * dy, cos2 * dy - sin2 * dx, cos, sin, second, first)


@kernel
def pillar_overlaps(poses: Any, i: int, pillars: Any, p: int, body: Any) -> bool:
    """Whether the ``Body`` of robot i overlaps pillar p; pillars (x, y, radius), shape (K, 3)."""
    dx, dy = pillars[p, 0] - poses[i, 0], pillars[p, 1] - poses[i, 1]
    if body.is_circle:
        return bool(math.hypot(dx, dy) < body.half_length + pillars[p, 2])
    return bool(_box_overlaps_circle(dx, dy, math.cos(poses[i, 2]), math.sin(poses[i, 2]), body, pillars[p, 2]))


@kernel
def wall_overlaps(poses: Any, i: int, walls: Any, w: int, body: Any) -> bool:
    """Whether the ``Body`` of robot i overlaps wall w; walls (x1, y1, x2, y2), shape (W, 4)."""
    half_length, half_width, is_circle = body
    x1, y1 = walls[w, 0] - poses[i, 0], walls[w, 1] - poses[i, 1]
    ex, ey = walls[w, 2] - walls[w, 0], walls[w, 3] - walls[w, 1]
    if is_circle:
        share = min(max(-(x1 * ex + y1 * ey) / (ex * ex + ey * ey), 0.0), 1.0)
        return bool(math.hypot(x1 + share * ex, y1 + share * ey) < half_length)
    cos, sin = math.cos(poses[i, 2]), math.sin(poses[i, 2])
    ax, ay = cos * x1 + sin * y1, cos * y1 - sin * x1
    bx, by = ax + cos * ex + sin * ey, ay + cos * ey - sin * ex
    if min(ax, bx) >= half_length or max(ax, bx) <= -half_length:
        return False
    if min(ay, by) >= half_width or max(ay, by) <= -half_width:
        return False
    return bool(abs(ax * by - ay * bx) < half_length * abs(by - ay) + half_width * abs(bx - ax))


@kernel
def any_hits_arena(poses: Any, active: Any, scene: Any) -> bool:
    """Whether any active footprint of one world overlaps a wall or pillar of ``Scene``; poses of shape (N, 3)."""
    bodies, walls, pillars = scene
    if walls.shape[0] + pillars.shape[0] == 0:
        return False
    for i in range(poses.shape[0]):
        if not active[i]:
            continue
        body = body_of(bodies, i)
        for w in range(walls.shape[0]):
            if wall_overlaps(poses, i, walls, w, body):
                return True
        for p in range(pillars.shape[0]):
            if pillar_overlaps(poses, i, pillars, p, body):
                return True
    return False
