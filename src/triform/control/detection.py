"""Scan -> centres of the neighbours, without learning.

1. Points are joined into *segments*: neighbours in angle that one surface explains (across the wrap-around too).
2. The known footprint is fitted to each segment (``_footprint_fit``), which corrects the near-side bias: the centroid
   of what is seen lies towards the observer. A segment that does not fit is split where its shape says so and tried
   again; what still does not fit is a wall or noise.
3. Fragments that one footprint explains together are one robot, cut in two by a robot before it or by a steep side.
4. Pieces of walls that look like a robot's side are rejected.

An unknown footprint is estimated first (``footprint_estimate``): robots that are seen whole are taken as they are, and
the footprint that they have in common is fitted to the rest of the scan.
"""

from __future__ import annotations

import numpy as np

from triform.control.footprint_estimate import take_whole_robots
from triform.control.footprint_fit import fit_footprint
from triform.control.footprint_geometry import CleanScan
from triform.control.segments import (
    MIN_POINTS,
    TOLERANCE,
    breaks,
    collect_points,
    find_edges,
    find_wall,
    fit_segment,
    longest_span,
    looks_like_wall,
    span,
    split_index,
)
from triform.kernels import kernel
from triform.threads import in_parts
from triform.types import Body, FloatArray, IntArray, Scan, require

#: Scans that keep a thread busy for a few milliseconds.
SCANS_PER_THREAD = 100
#: RoboMaster EP: length and width [m].
ROBOMASTER_EP_SIZE = (0.320, 0.240)
#: The footprint of which kernels know nothing.
UNKNOWN_BODY = Body(0.0, 0.0, True)


@kernel
def _fit_parts(sight, rays, points, count, footprint, parts, poses, costs, walls):
    """Cut the points into parts that each fit one robot, and walls.

    Args:
        sight: The whole scan.
        rays: Ray of each point, shape (>= count,).
        points: Points counter-clockwise [m], shape (>= count, 2).
        count: Number of points.
        footprint: (a, b, round).
        parts: Result, first and last (exclusive) point of each part, shape (count + 1, 2).
        poses: Result, fitted poses, shape (count + 1, 3).
        costs: Result, root mean cost [m]; ``inf`` for parts with too few points to be a robot, shape (count + 1,).
        walls: Result, lines of walls, shape (count + 1, 4).

    Returns:
        (number of parts, number of walls).
    """
    noise = sight.noise
    waiting = np.empty((count + 1, 2), dtype=np.int64)
    edges = np.empty((2, 2))
    found = wall_count = begin = 0
    for end in range(1, count + 1):
        if end < count and not breaks(sight, rays[end - 1], rays[end]):
            continue
        waiting[0, 0], waiting[0, 1] = begin, end
        left = 1
        begin = end
        while left > 0:
            left -= 1
            first, last = waiting[left]
            size = last - first
            piece = points[first:last]
            find_edges(sight, rays, first, last, edges)
            cost = fit_segment(piece, size, edges, footprint, sight, poses[found])
            if size < MIN_POINTS or cost <= TOLERANCE + noise:
                parts[found, 0], parts[found, 1] = first, last
                costs[found] = cost
                found += 1
                continue
            if find_wall(piece, size, footprint, noise, walls[wall_count]):
                wall_count += 1
                continue
            # What surrounds the observer has no chord to judge it by: halve it.
            surrounds = 3 * ((rays[last - 1] - rays[first]) % sight.ranges.shape[0]) > sight.ranges.shape[0]
            cut = size // 2 if surrounds else split_index(piece, size, noise)
            if 0 < cut < size:
                waiting[left, 0], waiting[left, 1] = first + cut, last
                waiting[left + 1, 0], waiting[left + 1, 1] = first, first + cut
                left += 2
    return found, wall_count


@kernel
def _reject_walls(sight, rays, points, parts, costs, found, walls, wall_count):
    """Empty the parts that may be pieces of walls."""
    edges = np.empty((2, 2))
    for i in range(found):
        first, last = parts[i]
        if costs[i] == np.inf:
            continue
        find_edges(sight, rays, first, last, edges)
        if looks_like_wall(points[first:last], last - first, edges, sight.noise, walls, wall_count):
            costs[i] = np.inf
            parts[i, 0] = parts[i, 1]


@kernel
def _fit_union(sight, rays, points, part, other, footprint, union, pose):
    """Fit one footprint to two parts together; return the root mean cost [m], ``inf`` if they span too much."""
    total, longest = sight.ranges.shape[0], longest_span(footprint, sight.noise)
    ahead = (rays[other[0]] - rays[part[1] - 1]) % total
    behind = (rays[part[0]] - rays[other[1] - 1]) % total
    early, late = (part, other) if ahead <= behind else (other, part)
    start, end = points[early[0]], points[late[1] - 1]
    if np.hypot(start[0] - end[0], start[1] - end[1]) > longest:
        return np.inf
    size = 0
    for piece in (early, late):
        for k in range(piece[0], piece[1]):
            union[size] = points[k]
            size += 1
    if span(union, size) > longest:
        return np.inf
    edges, inner = np.empty((2, 2)), np.empty((2, 2))
    find_edges(sight, rays, early[0], early[1], edges)
    find_edges(sight, rays, late[0], late[1], inner)
    edges[1] = inner[1]
    return fit_footprint(union, size, edges, footprint, sight, pose)


@kernel
def _join_parts(sight, rays, points, footprint, parts, poses, costs, found):
    """Join parts that one footprint explains together.

    The pose and cost of the union stay with the first part, which keeps the points of the larger one; the other is
    emptied.
    """
    union, pose = np.empty((points.shape[0], 2)), np.empty(3)
    for i in range(found):
        for j in range(found):
            if i == j or costs[i] == np.inf or parts[j, 0] == parts[j, 1]:
                continue
            cost = _fit_union(sight, rays, points, parts[i], parts[j], footprint, union, pose)
            if cost > TOLERANCE + sight.noise:
                continue
            poses[i] = pose
            costs[i] = cost
            if parts[j, 1] - parts[j, 0] > parts[i, 1] - parts[i, 0]:
                parts[i] = parts[j]
            costs[j] = np.inf
            parts[j, 0] = parts[j, 1]


@kernel
def _reject_overlaps(footprint, parts, poses, costs, found):
    """Of two robots closer than their narrow side, which cannot be, keep the one with more points."""
    closest = 2.0 * footprint[1]
    for i in range(found):
        for j in range(found):
            if i == j or costs[i] == np.inf or costs[j] == np.inf:
                continue
            larger = parts[i, 1] - parts[i, 0] >= parts[j, 1] - parts[j, 0]
            if larger and np.hypot(poses[i, 0] - poses[j, 0], poses[i, 1] - poses[j, 1]) < closest:
                costs[j] = np.inf


@kernel
def _is_near(pose, centres, count, closest):
    """Whether one of ``count`` centres is nearer to a pose than ``closest`` [m]."""
    near = False
    for k in range(count):
        near = near or np.hypot(pose[0] - centres[k, 0], pose[1] - centres[k, 1]) < closest
    return near


@kernel
def detect_into(ranges, footprint, directions, angle_min, range_max, noise, centres):
    """Detect the robots in one scan.

    Args:
        ranges: Measured ranges [m], shape (R,).
        footprint: (half length, half width, circle?) [m]; ``UNKNOWN_BODY`` to estimate it.
        directions: Unit vectors of the rays in the observer's frame, shape (R, 2).
        angle_min: Angle of the first ray [rad].
        range_max: Maximum range [m].
        noise: Standard deviation of measured ranges [m].
        centres: Centres to write in the observer's frame [m], shape (>= most_robots(R), 2).

    Returns:
        Number of robots.
    """
    total = ranges.shape[0]
    rays, points = np.empty(total, dtype=np.int64), np.empty((total, 2))
    sight = CleanScan(np.empty(total), directions, angle_min, range_max, noise)
    count = collect_points(ranges, sight, rays, points)
    whole = 0
    if footprint.half_length == 0.0:
        whole, count, footprint = take_whole_robots(sight, rays, points, count, centres)
    parts, poses = np.empty((count + 1, 2), dtype=np.int64), np.empty((count + 1, 3))
    costs, walls = np.empty(count + 1), np.empty((count + 1, 4))
    found, wall_count = _fit_parts(sight, rays, points, count, footprint, parts, poses, costs, walls)
    _reject_walls(sight, rays, points, parts, costs, found, walls, wall_count)
    _join_parts(sight, rays, points, footprint, parts, poses, costs, found)
    _reject_overlaps(footprint, parts, poses, costs, found)
    robots = whole
    for i in range(found):
        if costs[i] < np.inf and not _is_near(poses[i], centres, whole, 2.0 * footprint.half_width):
            centres[robots] = poses[i, :2]
            robots += 1
    return robots


@kernel
def most_robots(rays):
    """Return how many robots a scan of ``rays`` rays can show at most."""
    return rays // MIN_POINTS


@kernel
def _detect_scans(ranges, footprint, directions, angle_min, range_max, noise, centres, counts, first, last):
    for s in range(first, last):
        counts[s] = detect_into(ranges[s], footprint, directions, angle_min, range_max, noise, centres[s])


def kernel_footprint(footprint: tuple[float, float] | float) -> Body:
    """Return a footprint as kernels take it.

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
    return Body(sizes[0] / 2, sizes[1] / 2, not isinstance(footprint, tuple))


def fitted_footprint(footprint: tuple[float, float] | float | None) -> Body:
    """Return a footprint as ``detect_into`` takes it; ``None`` is an unknown one.

    Raises:
        ConfigurationError: If a size is not positive and finite.
    """
    return UNKNOWN_BODY if footprint is None else kernel_footprint(footprint)


def require_noise(noise: float) -> None:
    """Refuse a standard deviation of ranges that is negative or infinite.

    Raises:
        ConfigurationError: It is.
    """
    require(0 <= noise < np.inf, f"noise is {noise} m; it must be finite and not negative")


def ray_directions(scan: Scan) -> FloatArray:
    """Unit vectors of the rays in the robot's frame, shape (R, 2)."""
    angles = scan.config.angles
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def detect_robots(
    scan: Scan, footprint: tuple[float, float] | float | None = ROBOMASTER_EP_SIZE, noise: float = 0.0
) -> tuple[FloatArray, IntArray]:
    """Estimate the centres of the robots seen in each scan.

    ``NaN``, ``-inf`` and ranges that are not positive say nothing; ranges beyond ``range_max`` and ``+inf`` are free
    rays. A robot needs at least three points.

    Args:
        scan: Scans, ranges of shape (..., R).
        footprint: Length and width of the robots' box, or the diameter of a circle [m]; ``None`` to estimate it from
            each scan.
        noise: Standard deviation of measured ranges [m].

    Returns:
        Centres in the observer's frame [m], shape (..., M, 2), ``NaN`` beyond each scan's number of robots, with M
        the largest of those numbers; and those numbers, shape (...).

    Raises:
        ConfigurationError: If a size is not positive and finite, or the noise negative or infinite.
    """
    shape = fitted_footprint(footprint)
    require_noise(noise)
    ranges = np.ascontiguousarray(scan.ranges).reshape(-1, scan.config.rays)
    centres = np.full((len(ranges), most_robots(scan.config.rays), 2), np.nan)
    counts = np.zeros(len(ranges), dtype=np.int64)
    directions, config = ray_directions(scan), scan.config
    in_parts(
        lambda first, last: _detect_scans(
            ranges, shape, directions, config.angle_min, config.range_max, float(noise), centres, counts, first, last
        ),
        len(ranges), len(ranges), SCANS_PER_THREAD,
    )  # fmt: skip
    most = int(counts.max(initial=0))
    leading = scan.ranges.shape[:-1]
    return centres[:, :most].reshape(*leading, most, 2).copy(), counts.reshape(leading)
