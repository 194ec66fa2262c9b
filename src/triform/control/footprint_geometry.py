"""Kernels about a footprint of known size at a pose: what of it can be seen, and what a scan says about the pose.

Everything is in the observer's frame: the LiDAR is the origin.

- A *footprint* is ``(a, b, round)``: half length, half width [m], and whether it is a circle of radius ``a`` instead
  of an ``a`` by ``b`` box.
- A *pose* is the footprint's ``(x, y, heading)``. The heading of a box is known up to half a turn; that of a circle
  means nothing.
- A *sight* is the whole scan, see ``CleanScan``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from triform.kernels import kernel

#: By how many standard deviations of the range noise what is allowed of a single point grows, and of two points.
ONE_POINT = 3.0
TWO_POINTS = 4.0
#: A point or ray that disagrees by more than this counts as an outlier and costs no more [m].
OUTLIER = 0.06
#: A ray may pass this deep through a footprint before it counts as evidence against it [m].
DEPTH_SLACK = 0.02


class CleanScan(NamedTuple):
    """A scan of R rays, as it is used.

    Attributes:
        ranges: Clean ranges [m]: ``inf`` where the ray is free up to ``range_max``, ``NaN`` where nothing is known,
            shape (R,).
        directions: Unit vectors of the rays, shape (R, 2).
        angle_min: Angle of the first ray [rad].
        range_max: Farther returns are free rays [m].
        noise: Standard deviation of measured ranges [m]. What is allowed of points grows with it.
    """

    ranges: Any
    directions: Any
    angle_min: float
    range_max: float
    noise: float


@kernel
def surface_residual(x, y, pose, cosine, sine, a, b, round_):
    """Where a point lies relative to the nearest visible side.

    Returns:
        (height over the side, outward normal of the side in the footprint's frame (2), signed distance beyond the
        end of the side, direction of that excess (2), the point in the footprint's frame (2)).
    """
    shift_x, shift_y = x - pose[0], y - pose[1]
    u = cosine * shift_x + sine * shift_y
    v = -sine * shift_x + cosine * shift_y
    if round_:
        distance = max(np.hypot(u, v), 1e-9)
        return distance - a, u / distance, v / distance, 0.0, 0.0, 0.0, u, v
    eye_u = -cosine * pose[0] - sine * pose[1]
    eye_v = sine * pose[0] - cosine * pose[1]
    side_u = 1.0 if eye_u > 0 else -1.0
    side_v = 1.0 if eye_v > 0 else -1.0
    height_u, beyond_u = side_u * u - a, max(abs(v) - b, 0.0)
    height_v, beyond_v = side_v * v - b, max(abs(u) - a, 0.0)
    sees_u, sees_v = abs(eye_u) > a, abs(eye_v) > b
    if not sees_u and not sees_v:
        sees_u = sees_v = True
    nearer_u = height_u * height_u + beyond_u * beyond_u <= height_v * height_v + beyond_v * beyond_v
    if sees_u and (nearer_u or not sees_v):
        return height_u, side_u, 0.0, beyond_u, 0.0, 1.0 if v > 0 else -1.0, u, v
    return height_v, 0.0, side_v, beyond_v, 1.0 if u > 0 else -1.0, 0.0, u, v


@kernel
def ray_interval(direction_x, direction_y, pose, cosine, sine, a, b, round_):
    """Ranges at which a ray from the origin enters and leaves the footprint; entry ``inf`` if it misses."""
    if round_:
        along = direction_x * pose[0] + direction_y * pose[1]
        squared = along * along - (pose[0] * pose[0] + pose[1] * pose[1]) + a * a
        if squared <= 0.0 or along <= 0.0:
            return np.inf, np.inf
        half_chord = np.sqrt(squared)
        return along - half_chord, along + half_chord
    origin_u = -cosine * pose[0] - sine * pose[1]
    origin_v = sine * pose[0] - cosine * pose[1]
    along_u = cosine * direction_x + sine * direction_y
    along_v = -sine * direction_x + cosine * direction_y
    entry, leave = -np.inf, np.inf
    for origin, along, half in ((origin_u, along_u, a), (origin_v, along_v, b)):
        if abs(along) < 1e-12:
            if abs(origin) > half:
                return np.inf, np.inf
            continue
        middle, reach = -origin / along, half / abs(along)
        entry = max(entry, middle - reach)
        leave = min(leave, middle + reach)
    if entry >= leave or leave <= 0.0:
        return np.inf, np.inf
    return entry, leave


@kernel
def pose_cost(points, count, pose, footprint, sight):
    """Sum of squared disagreements of a pose with points and rays [m^2], each at most that of an outlier.

    Every point should lie on a side that the observer can see, and no ray that went farther should pass through the
    footprint. A ray that stopped before it proves nothing: whoever stopped it may hide part of the footprint.

    Args:
        points: The robot's points [m], shape (>= count, 2).
        count: Number of points.
        pose: Pose to judge, shape (3,).
        footprint: (a, b, round).
        sight: The whole scan.
    """
    a, b, round_ = footprint
    ranges, directions, angle_min, range_max, noise = sight
    worst = (OUTLIER + ONE_POINT * noise) ** 2
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    cost = 0.0
    for i in range(count):
        height, _, _, beyond, _, _, _, _ = surface_residual(
            points[i, 0], points[i, 1], pose, cosine, sine, a, b, round_
        )
        cost += min(height * height + beyond * beyond, worst)

    rays = ranges.shape[0]
    increment = 2.0 * np.pi / rays
    radius = a if round_ else np.hypot(a, b)
    distance = np.hypot(pose[0], pose[1])
    if distance <= radius:
        return cost + rays * worst
    bearing, half_angle = np.arctan2(pose[1], pose[0]), np.arcsin(radius / distance)
    first = int(np.ceil((bearing - half_angle - angle_min) / increment))
    last = int(np.floor((bearing + half_angle - angle_min) / increment))
    for k in range(first, last + 1):
        ray = k % rays
        measured = ranges[ray]
        if np.isnan(measured):
            continue
        entry, leave = ray_interval(directions[ray, 0], directions[ray, 1], pose, cosine, sine, a, b, round_)
        depth = min(measured, range_max, leave) - entry - DEPTH_SLACK - ONE_POINT * noise
        if depth > 0.0:
            cost += min(depth * depth, worst)
    return cost


@kernel
def mean_depth(a, b, round_):
    """How far the centre lies behind the seen surface, averaged over headings and rays [m].

    Half the mean chord of a convex shape, which is pi * area / perimeter (Cauchy, Crofton).
    """
    if round_:
        return np.pi * a / 4.0
    return np.pi * a * b / (2.0 * (a + b))


@kernel
def mean_half_width(a, b, round_):
    """Half the width of the silhouette, averaged over headings [m]: perimeter / (2 pi) (Cauchy)."""
    if round_:
        return a
    return 2.0 * (a + b) / np.pi
