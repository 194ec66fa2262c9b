"""Kernels that fit a footprint of known size to the points one robot returned.

Footprints, poses and sights are those of ``_footprint_geometry``, and the observer is the origin. The search places
the footprint at a grid of headings by its extents, keeps the best few by ``pose_cost`` and improves them by damped
Gauss-Newton on the same residuals.
"""

from __future__ import annotations

import numpy as np

from triform.control.footprint_geometry import ONE_POINT, mean_depth, mean_half_width, pose_cost, surface_residual
from triform.kernels import kernel

#: Headings tried per half turn.
HEADINGS = 18
#: Best placements that are improved.
STARTS = 3
#: Gauss-Newton steps per start, and for the winner.
STEPS_START = 4
STEPS_FINAL = 6
#: Arm that makes a turn comparable with a shift [m].
ARM = 0.15
#: Scale of the Cauchy weights against outliers [m].
ROBUST_SCALE = 0.03
#: Weight of a silhouette ray inside and beyond the gap between the last hit and the first miss.
EDGE_WEIGHT_INSIDE = 0.1
EDGE_WEIGHT_BEYOND = 1.0


@kernel
def _accumulate(normal, gradient, residual, j_x, j_y, j_t, weight):
    """Add one weighted residual with Jacobian (j_x, j_y, j_t) to the normal equations."""
    normal[0, 0] += weight * j_x * j_x
    normal[0, 1] += weight * j_x * j_y
    normal[0, 2] += weight * j_x * j_t
    normal[1, 1] += weight * j_y * j_y
    normal[1, 2] += weight * j_y * j_t
    normal[2, 2] += weight * j_t * j_t
    gradient[0] += weight * residual * j_x
    gradient[1] += weight * residual * j_y
    gradient[2] += weight * residual * j_t


@kernel
def _solve_symmetric(normal, gradient, step):
    """Solve the positive definite 3 x 3 system (upper triangle given) for ``step`` by elimination."""
    m00, m01, m02 = normal[0, 0], normal[0, 1], normal[0, 2]
    factor1, factor2 = m01 / m00, m02 / m00
    m11 = normal[1, 1] - factor1 * m01
    m12 = normal[1, 2] - factor1 * m02
    m22 = normal[2, 2] - factor2 * m02
    g1 = gradient[1] - factor1 * gradient[0]
    g2 = gradient[2] - factor2 * gradient[0]
    factor3 = m12 / m11
    step[2] = (g2 - factor3 * g1) / (m22 - factor3 * m12)
    step[1] = (g1 - m12 * step[2]) / m11
    step[0] = (gradient[0] - m01 * step[1] - m02 * step[2]) / m00


@kernel
def improve_pose(points, count, edges, pose, footprint, noise, steps):
    """Improve a pose in place by damped Gauss-Newton steps.

    Residuals are the heights of the points over the visible sides (Cauchy weights), their excess beyond a side's
    end, and the distance of the footprint's silhouette from the ray halfway between the last hit and the first
    miss. The last kind is weak while the silhouette stays between those two rays: there it only settles what the
    points leave open, such as the position along a single visible side.

    Args:
        points: The robot's points [m], shape (>= count, 2).
        count: Number of points.
        edges: Clockwise, then counter-clockwise silhouette: (angle, half gap) [rad], ``NaN`` if hidden, shape (2, 2).
        pose: Pose to improve, shape (3,).
        footprint: (a, b, round).
        noise: Standard deviation of measured ranges [m].
        steps: Number of steps.
    """
    a, b, round_ = footprint
    scale_squared = (ROBUST_SCALE + ONE_POINT * noise) ** 2
    normal, gradient, step = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for _ in range(steps):
        cosine, sine = np.cos(pose[2]), np.sin(pose[2])
        normal[:] = 0.0
        gradient[:] = 0.0
        for i in range(count):
            height, n_u, n_v, beyond, t_u, t_v, u, v = surface_residual(
                points[i, 0], points[i, 1], pose, cosine, sine, a, b, round_
            )
            weight = 1.0 / (1.0 + (height * height + beyond * beyond) / scale_squared)
            _accumulate(
                normal, gradient, height,
                -(cosine * n_u - sine * n_v), -(sine * n_u + cosine * n_v), (n_u * v - n_v * u) / ARM, weight,
            )  # fmt: skip
            if beyond > 0.0:
                _accumulate(
                    normal, gradient, beyond,
                    -(cosine * t_u - sine * t_v), -(sine * t_u + cosine * t_v), (t_u * v - t_v * u) / ARM, weight,
                )  # fmt: skip
        distance = np.hypot(pose[0], pose[1])
        for side in range(2):
            angle = edges[side, 0]
            if np.isnan(angle):
                continue
            inward = 1.0 if side == 0 else -1.0
            n_x, n_y = -inward * np.sin(angle), inward * np.cos(angle)
            n_u, n_v = cosine * n_x + sine * n_y, -sine * n_x + cosine * n_y
            if round_:
                support, turn = a, 0.0
            else:
                support = a * abs(n_u) + b * abs(n_v)
                turn = a * np.sign(n_u) * n_v - b * np.sign(n_v) * n_u
            residual = n_x * pose[0] + n_y * pose[1] - support
            slack = edges[side, 1] * distance
            weight = EDGE_WEIGHT_INSIDE**2
            if abs(residual) > slack:
                weight = EDGE_WEIGHT_BEYOND**2 / (1.0 + (residual / ROBUST_SCALE) ** 2)
            _accumulate(normal, gradient, residual, n_x, n_y, -turn / ARM, weight)
        for k in range(3):
            normal[k, k] += 1e-4 + 1e-3 * normal[k, k]
        _solve_symmetric(normal, gradient, step)
        length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        scale = min(1.0, 0.08 / max(length, 1e-12))
        pose[0] -= scale * step[0]
        pose[1] -= scale * step[1]
        pose[2] -= scale * step[2] / ARM


@kernel
def push_centroid(points, count, edges, footprint, pose):
    """Guess a pose from too few points: the seen surface, pushed outward by the mean depth.

    If only one edge of the silhouette is free, the footprint reaches from there towards the hidden side by its
    mean width.
    """
    a, b, round_ = footprint
    x, y = points[:count, 0].mean(), points[:count, 1].mean()
    distance = max(np.hypot(x, y), 1e-9)
    first_free, last_free = not np.isnan(edges[0, 0]), not np.isnan(edges[1, 0])
    if first_free != last_free:
        end = 0 if first_free else count - 1
        turn = 1.0 if first_free else -1.0
        lateral = (points[end, 1] * x - points[end, 0] * y) / distance + turn * mean_half_width(a, b, round_)
        x, y = x - lateral * y / distance, y + lateral * x / distance
    scale = 1.0 + mean_depth(a, b, round_) / distance
    pose[0], pose[1], pose[2] = x * scale, y * scale, 0.0


@kernel
def _placements(low, high, low_free, high_free, half, out):
    """Write up to two centre coordinates of a span of half size ``half`` that holds points in [low, high].

    The observer is at zero. Points all on one side of it start at the near side, unless that end is hidden: then
    they may also end at the far end. Points on both sides mean that the near side is not seen and that the ends,
    if free, are the footprint's own.
    """
    if low > 0.0 or high < 0.0:
        near_low = low > 0.0
        out[0] = low + half if near_low else high - half
        out[1] = high - half if near_low else low + half
        return 2
    if low_free == high_free:
        out[0] = 0.5 * (low + high)
    elif low_free:
        out[0] = low + half
    else:
        out[0] = high - half
    return 1


@kernel
def _keep_best(cost, pose, best_costs, best_poses):
    """Insert a pose into the sorted list of the best ones."""
    slot = best_costs.shape[0]
    while slot > 0 and cost < best_costs[slot - 1]:
        slot -= 1
    if slot == best_costs.shape[0]:
        return
    for k in range(best_costs.shape[0] - 1, slot, -1):
        best_costs[k] = best_costs[k - 1]
        best_poses[k] = best_poses[k - 1]
    best_costs[slot] = cost
    best_poses[slot] = pose


@kernel
def _search_headings(points, count, edges, footprint, sight, costs, poses):
    """Fill ``costs`` and ``poses`` with the best placements over a grid of headings."""
    a, b, _ = footprint
    first_free, last_free = not np.isnan(edges[0, 0]), not np.isnan(edges[1, 0])
    pose, along_u, along_v = np.empty(3), np.empty(2), np.empty(2)
    for step in range(HEADINGS):
        heading = np.pi * step / HEADINGS
        cosine, sine = np.cos(heading), np.sin(heading)
        low_u = low_v = np.inf
        high_u = high_v = -np.inf
        for i in range(count):
            u = cosine * points[i, 0] + sine * points[i, 1]
            v = -sine * points[i, 0] + cosine * points[i, 1]
            low_u, high_u = min(low_u, u), max(high_u, u)
            low_v, high_v = min(low_v, v), max(high_v, v)
        span_x, span_y = points[count - 1, 0] - points[0, 0], points[count - 1, 1] - points[0, 1]
        rising_u = cosine * span_x + sine * span_y > 0.0
        rising_v = -sine * span_x + cosine * span_y > 0.0
        free_low_u, free_high_u = (first_free, last_free) if rising_u else (last_free, first_free)
        free_low_v, free_high_v = (first_free, last_free) if rising_v else (last_free, first_free)
        options_u = _placements(low_u, high_u, free_low_u, free_high_u, a, along_u)
        options_v = _placements(low_v, high_v, free_low_v, free_high_v, b, along_v)
        for i in range(options_u):
            for j in range(options_v):
                pose[0] = cosine * along_u[i] - sine * along_v[j]
                pose[1] = sine * along_u[i] + cosine * along_v[j]
                pose[2] = heading
                cost = pose_cost(points, count, pose, footprint, sight)
                _keep_best(cost, pose, costs, poses)


@kernel
def fit_footprint(points, count, edges, footprint, sight, pose):
    """Fit the footprint to the points of one robot.

    Args:
        points: The robot's points in counter-clockwise order [m], shape (>= count, 2).
        count: Number of points, at least 1.
        edges: Silhouette rays, see ``improve_pose``.
        footprint: (a, b, round).
        sight: The whole scan.
        pose: Fitted pose to write, shape (3,).

    Returns:
        Root of the cost per point [m].
    """
    _, _, round_ = footprint
    costs, poses = np.full(STARTS, np.inf), np.zeros((STARTS, 3))
    push_centroid(points, count, edges, footprint, pose)
    if round_:
        poses[0] = pose
        costs[0] = 0.0
    else:
        _search_headings(points, count, edges, footprint, sight, costs, poses)
    best = np.inf
    for k in range(STARTS):
        if costs[k] == np.inf:
            break
        improve_pose(points, count, edges, poses[k], footprint, sight.noise, STEPS_START)
        cost = pose_cost(points, count, poses[k], footprint, sight)
        if cost < best:
            best = cost
            pose[:] = poses[k]
    poses[0] = pose
    improve_pose(points, count, edges, poses[0], footprint, sight.noise, STEPS_FINAL)
    cost = pose_cost(points, count, poses[0], footprint, sight)
    if cost <= best:
        best = cost
        pose[:] = poses[0]
    return np.sqrt(best / count)
