"""Scan -> centres of the neighbours, without learning.

1. Points are joined into *segments*: neighbours in angle that one surface explains (across the wrap-around too).
2. The known footprint is fitted to each segment (``_footprint_fit``), which corrects the near-side bias: the centroid
   of what is seen lies towards the observer. A segment that does not fit is split where its shape says so and tried
   again; what still does not fit is a wall or noise.
3. Fragments that one footprint explains together are one robot, cut in two by a robot before it or by a steep side.
4. Pieces of walls that look like a robot's side are rejected.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from triform.control._footprint_fit import fit_footprint
from triform.control._segments import (
    MIN_POINTS,
    SPAN_SLACK,
    TOLERANCE,
    _breaks,
    collect_points,
    find_edges,
    find_wall,
    fit_segment,
    looks_like_wall,
    span,
    split_index,
)
from triform.types import FloatArray, IntArray, Scan, require

#: RoboMaster EP: length and width [m].
ROBOMASTER_EP_SIZE = (0.320, 0.240)
#: Segments and robots considered per scan; a scan holds far fewer.
MAX_SEGMENTS = 128


@njit(cache=True, nogil=True)
def _segment_scan(clean, rays, points, count, footprint, directions, angle_min, range_max, parts, poses, costs, walls):  # type: ignore[no-untyped-def]
    """Cut the points into parts that each fit one robot.

    Args:
        parts: Result, first and last (exclusive) point of each part, shape (MAX_SEGMENTS, 2).
        poses: Result, fitted poses, shape (MAX_SEGMENTS, 3).
        costs: Result, root mean cost [m]; ``inf`` for fragments too small to be a robot, shape (MAX_SEGMENTS,).
        walls: Result, lines of walls, shape (MAX_SEGMENTS, 4).

    Returns:
        (number of parts, number of walls).
    """
    a, b, round_ = footprint
    diagonal = 2.0 * a if round_ else 2.0 * np.hypot(a, b)
    stack = np.empty((2 * MAX_SEGMENTS, 2), dtype=np.int64)
    edges = np.empty((2, 2))
    found = wall_count = 0
    begin = 0
    for end in range(1, count + 1):
        if end < count and not _breaks(clean, directions, rays[end - 1], rays[end]):
            continue
        stack[0, 0], stack[0, 1] = begin, end
        height = 1
        begin = end
        while height > 0:
            height -= 1
            first, last = stack[height]
            size = last - first
            piece = points[first:last]
            cost = np.inf
            if size >= MIN_POINTS:
                find_edges(clean, rays, first, last, angle_min, range_max, edges)
                cost = fit_segment(piece, size, edges, footprint, clean, directions, angle_min, range_max, poses[found])
            if size < MIN_POINTS or cost <= TOLERANCE:
                if found < MAX_SEGMENTS - 1:
                    parts[found, 0], parts[found, 1] = first, last
                    costs[found] = cost
                    found += 1
                continue
            if wall_count < MAX_SEGMENTS and find_wall(piece, size, diagonal, walls[wall_count]):
                wall_count += 1
                continue
            # What surrounds the observer has no chord to judge it by: halve it.
            surrounds = 3 * ((rays[last - 1] - rays[first]) % clean.shape[0]) > clean.shape[0]
            cut = size // 2 if surrounds else split_index(piece, size)
            if 0 < cut < size and height + 2 <= stack.shape[0]:
                stack[height, 0], stack[height, 1] = first + cut, last
                stack[height + 1, 0], stack[height + 1, 1] = first, first + cut
                height += 2
    return found, wall_count


@njit(cache=True, nogil=True)
def _merge_parts(clean, rays, points, count, footprint, directions, angle_min, range_max, parts, poses, costs, found):  # type: ignore[no-untyped-def]
    """Join parts that one footprint explains together; drop what cannot be a robot beside another one.

    A dropped or absorbed part gets cost ``inf``.
    """
    a, b, round_ = footprint
    diagonal = 2.0 * a if round_ else 2.0 * np.hypot(a, b)
    union, edges, outer = np.empty((points.shape[0], 2)), np.empty((2, 2)), np.empty((2, 2))
    pose = np.empty(3)
    for i in range(found):
        for j in range(found):
            if i == j or costs[i] == np.inf or parts[j, 0] == parts[j, 1]:
                continue
            # Part j follows part i counter-clockwise, or the other way round, whichever gap is smaller.
            rays_total = clean.shape[0]
            ahead = (rays[parts[j, 0]] - rays[parts[i, 1] - 1]) % rays_total
            behind = (rays[parts[i, 0]] - rays[parts[j, 1] - 1]) % rays_total
            early, late = (i, j) if ahead <= behind else (j, i)
            size = 0
            for part in (early, late):
                for k in range(parts[part, 0], parts[part, 1]):
                    union[size] = points[k]
                    size += 1
            if np.hypot(union[0, 0] - union[size - 1, 0], union[0, 1] - union[size - 1, 1]) > diagonal + SPAN_SLACK:
                continue
            if span(union, size) > diagonal + SPAN_SLACK:
                continue
            find_edges(clean, rays, parts[early, 0], parts[early, 1], angle_min, range_max, edges)
            find_edges(clean, rays, parts[late, 0], parts[late, 1], angle_min, range_max, outer)
            edges[1] = outer[1]
            cost = fit_footprint(union, size, edges, footprint, clean, directions, angle_min, range_max, pose)
            if cost > TOLERANCE:
                continue
            # The union lives on in part i for the output alone: its points stay those of the larger part.
            poses[i] = pose
            costs[i] = cost
            if parts[j, 1] - parts[j, 0] > parts[i, 1] - parts[i, 0]:
                parts[i] = parts[j]
            costs[j] = np.inf
            parts[j, 0] = parts[j, 1]
    narrow = 2.0 * b
    for i in range(found):
        for j in range(found):
            if i == j or costs[i] == np.inf or costs[j] == np.inf:
                continue
            if parts[i, 1] - parts[i, 0] < parts[j, 1] - parts[j, 0]:
                continue
            if np.hypot(poses[i, 0] - poses[j, 0], poses[i, 1] - poses[j, 1]) < narrow:
                costs[j] = np.inf


@njit(cache=True, nogil=True)
def detect_into(ranges, footprint, directions, angle_min, range_max, centres):  # type: ignore[no-untyped-def]
    """Detect the robots in one scan.

    Args:
        ranges: Measured ranges [m], shape (R,).
        footprint: (half length, half width, circle?) [m].
        directions: Unit vectors of the rays in the observer's frame, shape (R, 2).
        angle_min: Angle of the first ray [rad].
        range_max: Maximum range [m].
        centres: Centres to write in the observer's frame [m], shape (M, 2).

    Returns:
        Number of robots, at most M.
    """
    total = ranges.shape[0]
    clean, rays, points = np.empty(total), np.empty(total, dtype=np.int64), np.empty((total, 2))
    count = collect_points(ranges, range_max, directions, clean, rays, points)
    parts, poses = np.empty((MAX_SEGMENTS, 2), dtype=np.int64), np.empty((MAX_SEGMENTS, 3))
    costs, walls = np.empty(MAX_SEGMENTS), np.empty((MAX_SEGMENTS, 4))
    edges = np.empty((2, 2))
    found, wall_count = _segment_scan(
        clean, rays, points, count, footprint, directions, angle_min, range_max, parts, poses, costs, walls
    )
    for i in range(found):
        if costs[i] == np.inf:
            continue
        first, last = parts[i]
        find_edges(clean, rays, first, last, angle_min, range_max, edges)
        if looks_like_wall(points[first:last], last - first, edges, walls, wall_count):
            costs[i] = np.inf
            parts[i, 0] = parts[i, 1]
    _merge_parts(clean, rays, points, count, footprint, directions, angle_min, range_max, parts, poses, costs, found)
    robots = 0
    for i in range(found):
        if costs[i] < np.inf and robots < centres.shape[0]:
            centres[robots] = poses[i, :2]
            robots += 1
    return robots


@njit(cache=True, nogil=True, parallel=True)
def _detect_scans(ranges, footprint, directions, angle_min, range_max, centres, counts):  # type: ignore[no-untyped-def]
    for s in prange(ranges.shape[0]):
        counts[s] = detect_into(ranges[s], footprint, directions, angle_min, range_max, centres[s])


def kernel_footprint(footprint: tuple[float, float] | float) -> tuple[float, float, bool]:
    """Return (half length, half width, circle?) [m] for the kernels.

    Args:
        footprint: Length and width of a box, or the diameter of a circle [m].

    Raises:
        ConfigurationError: If a size is not positive and finite.
    """
    sizes = footprint if isinstance(footprint, tuple) else (footprint, footprint)
    require(
        len(sizes) == 2 and all(0 < size < np.inf for size in sizes),
        f"footprint is {footprint}; it must be the length and width of a box or the diameter of a circle, "
        "positive and finite [m]",
    )
    return sizes[0] / 2, sizes[1] / 2, not isinstance(footprint, tuple)


def ray_directions(scan: Scan) -> FloatArray:
    """Unit vectors of the rays in the robot's frame, shape (R, 2)."""
    angles = scan.config.angles
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def detect_robots(
    scan: Scan, footprint: tuple[float, float] | float = ROBOMASTER_EP_SIZE
) -> tuple[FloatArray, IntArray]:
    """Estimate the centres of the robots seen in each scan.

    ``NaN``, ``-inf`` and ranges that are not positive say nothing; ranges beyond ``range_max`` and ``+inf`` are free
    rays. A robot needs at least three points.

    Args:
        scan: Scans, ranges of shape (..., R).
        footprint: Length and width of the robots' box, or the diameter of a circle [m].

    Returns:
        Centres in the observer's frame [m], shape (..., M, 2), ``NaN`` beyond each scan's number of robots, with M
        the largest of those numbers; and those numbers, shape (...).

    Raises:
        ConfigurationError: If a size is not positive and finite.
    """
    shape = kernel_footprint(footprint)
    ranges = np.ascontiguousarray(scan.ranges, dtype=np.float64).reshape(-1, scan.config.rays)
    centres = np.full((len(ranges), MAX_SEGMENTS, 2), np.nan)
    counts = np.zeros(len(ranges), dtype=np.int64)
    _detect_scans(ranges, shape, ray_directions(scan), scan.config.angle_min, scan.config.range_max, centres, counts)
    most = int(counts.max(initial=0))
    leading = scan.ranges.shape[:-1]
    return centres[:, :most].reshape(*leading, most, 2).copy(), counts.reshape(leading)
