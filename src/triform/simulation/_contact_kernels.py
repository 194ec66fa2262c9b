"""Compiled overlap tests between footprints, walls and pillars. Touching is no overlap."""

from __future__ import annotations

import math
from typing import Any

from numba import njit


@njit(cache=True, nogil=True)
def _axis_separates(dx: float, dy: float, cos: float, sin: float, half_length: float, half_width: float) -> bool:
    """Whether an axis of the first box separates two equal boxes.

    Args:
        dx: Centre of the second box in the frame of the first [m].
        dy: As ``dx``.
        cos: Cosine of the angle between the boxes.
        sin: Sine of the angle between the boxes.
        half_length: Half the boxes' length [m].
        half_width: Half the boxes' width [m].
    """
    cos = abs(cos)
    sin = abs(sin)
    return (
        abs(dx) >= half_length + half_length * cos + half_width * sin
        or abs(dy) >= half_width + half_length * sin + half_width * cos
    )


@njit(cache=True, nogil=True)
def robots_overlap(first: Any, second: Any, half_length: float, half_width: float, is_circle: bool) -> bool:
    """Whether the footprints of two robots at poses of shape (3,) overlap (separating axis test)."""
    dx = second[0] - first[0]
    dy = second[1] - first[1]
    squared = dx * dx + dy * dy
    if is_circle:
        return bool(squared < 4 * half_length * half_length)
    if squared >= 4 * (half_length * half_length + half_width * half_width):
        return False
    cos1 = math.cos(first[2])
    sin1 = math.sin(first[2])
    cos2 = math.cos(second[2])
    sin2 = math.sin(second[2])
    cos = cos1 * cos2 + sin1 * sin2
    sin = cos1 * sin2 - sin1 * cos2
    if _axis_separates(cos1 * dx + sin1 * dy, cos1 * dy - sin1 * dx, cos, sin, half_length, half_width):
        return False
    return not _axis_separates(cos2 * dx + sin2 * dy, cos2 * dy - sin2 * dx, cos, sin, half_length, half_width)


@njit(cache=True, nogil=True)
def pillar_overlaps(pose: Any, pillar: Any, half_length: float, half_width: float, is_circle: bool) -> bool:
    """Whether a robot's footprint overlaps a pillar (x, y, radius)."""
    dx = pillar[0] - pose[0]
    dy = pillar[1] - pose[1]
    if is_circle:
        return bool(math.hypot(dx, dy) < half_length + pillar[2])
    cos = math.cos(pose[2])
    sin = math.sin(pose[2])
    outside_x = max(abs(cos * dx + sin * dy) - half_length, 0.0)
    outside_y = max(abs(cos * dy - sin * dx) - half_width, 0.0)
    return bool(math.hypot(outside_x, outside_y) < pillar[2])


@njit(cache=True, nogil=True)
def wall_overlaps(pose: Any, wall: Any, half_length: float, half_width: float, is_circle: bool) -> bool:
    """Whether a robot's footprint overlaps a wall (x1, y1, x2, y2)."""
    x1 = wall[0] - pose[0]
    y1 = wall[1] - pose[1]
    ex = wall[2] - wall[0]
    ey = wall[3] - wall[1]
    if is_circle:
        share = min(max(-(x1 * ex + y1 * ey) / (ex * ex + ey * ey), 0.0), 1.0)
        return bool(math.hypot(x1 + share * ex, y1 + share * ey) < half_length)
    cos = math.cos(pose[2])
    sin = math.sin(pose[2])
    ax = cos * x1 + sin * y1
    ay = cos * y1 - sin * x1
    bx = ax + cos * ex + sin * ey
    by = ay + cos * ey - sin * ex
    if min(ax, bx) >= half_length or max(ax, bx) <= -half_length:
        return False
    if min(ay, by) >= half_width or max(ay, by) <= -half_width:
        return False
    return bool(abs(ax * by - ay * bx) < half_length * abs(by - ay) + half_width * abs(bx - ax))


@njit(cache=True, nogil=True)
def closest_pair(poses: Any, active: Any) -> float:
    """Return the smallest distance between two active centres [m]; ``inf`` without a pair."""
    squared = math.inf
    for i in range(poses.shape[0]):
        if active[i]:
            for j in range(i):
                if active[j]:
                    dx = poses[i, 0] - poses[j, 0]
                    dy = poses[i, 1] - poses[j, 1]
                    squared = min(squared, dx * dx + dy * dy)
    return math.sqrt(squared)


@njit(cache=True, nogil=True)
def any_robots_overlap(poses: Any, active: Any, half_length: float, half_width: float, is_circle: bool) -> bool:
    """Whether any two active footprints of one world overlap; poses of shape (N, 3)."""
    for i in range(poses.shape[0]):
        if active[i]:
            for j in range(i):
                if active[j] and robots_overlap(poses[i], poses[j], half_length, half_width, is_circle):
                    return True
    return False


@njit(cache=True, nogil=True)
def any_hits_arena(
    poses: Any,
    active: Any,
    half_length: float,
    half_width: float,
    is_circle: bool,
    walls: Any,
    pillars: Any,
) -> bool:
    """Whether any active footprint of one world overlaps a wall or pillar; poses of shape (N, 3)."""
    for i in range(poses.shape[0]):
        if not active[i]:
            continue
        for w in range(walls.shape[0]):
            if wall_overlaps(poses[i], walls[w], half_length, half_width, is_circle):
                return True
        for p in range(pillars.shape[0]):
            if pillar_overlaps(poses[i], pillars[p], half_length, half_width, is_circle):
                return True
    return False
