"""Compiled overlap tests between footprints, walls and pillars. Touching is no overlap."""

from __future__ import annotations

import math
from typing import Any

from triform.kernels import kernel


@kernel
def _axis_separates(dx: float, dy: float, cos: float, sin: float, half_length: float, half_width: float) -> bool:
    """Whether an axis of a box separates it from an equal one at (dx, dy), turned by (cos, sin), in its own frame."""
    cos, sin = abs(cos), abs(sin)
    return (
        abs(dx) >= half_length + half_length * cos + half_width * sin
        or abs(dy) >= half_width + half_length * sin + half_width * cos
    )


@kernel
def robots_overlap(poses: Any, i: int, j: int, body: Any) -> bool:
    """Whether the footprints of robots i and j, poses of shape (N, 3), overlap (separating axis test)."""
    half_length, half_width, is_circle = body
    dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
    squared = dx * dx + dy * dy
    if is_circle:
        return bool(squared < 4 * half_length * half_length)
    if squared >= 4 * (half_length * half_length + half_width * half_width):
        return False
    cos1, sin1 = math.cos(poses[i, 2]), math.sin(poses[i, 2])
    cos2, sin2 = math.cos(poses[j, 2]), math.sin(poses[j, 2])
    cos, sin = cos1 * cos2 + sin1 * sin2, cos1 * sin2 - sin1 * cos2
    if _axis_separates(cos1 * dx + sin1 * dy, cos1 * dy - sin1 * dx, cos, sin, half_length, half_width):
        return False
    return not _axis_separates(cos2 * dx + sin2 * dy, cos2 * dy - sin2 * dx, cos, sin, half_length, half_width)


@kernel
def pillar_overlaps(poses: Any, i: int, pillars: Any, p: int, body: Any) -> bool:
    """Whether the footprint of robot i overlaps pillar p; pillars (x, y, radius), shape (K, 3)."""
    half_length, half_width, is_circle = body
    dx, dy = pillars[p, 0] - poses[i, 0], pillars[p, 1] - poses[i, 1]
    if is_circle:
        return bool(math.hypot(dx, dy) < half_length + pillars[p, 2])
    cos, sin = math.cos(poses[i, 2]), math.sin(poses[i, 2])
    outside_x = max(abs(cos * dx + sin * dy) - half_length, 0.0)
    outside_y = max(abs(cos * dy - sin * dx) - half_width, 0.0)
    return bool(math.hypot(outside_x, outside_y) < pillars[p, 2])


@kernel
def wall_overlaps(poses: Any, i: int, walls: Any, w: int, body: Any) -> bool:
    """Whether the footprint of robot i overlaps wall w; walls (x1, y1, x2, y2), shape (W, 4)."""
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
    body, walls, pillars = scene
    for i in range(poses.shape[0]):
        if not active[i]:
            continue
        for w in range(walls.shape[0]):
            if wall_overlaps(poses, i, walls, w, body):
                return True
        for p in range(pillars.shape[0]):
            if pillar_overlaps(poses, i, pillars, p, body):
                return True
    return False
