"""Kernels that estimate the footprints of robots of unknown size from one scan.

A segment that is seen whole, with free silhouette edges on both sides, says how wide its robot is. It is

- a *disc* that touches both silhouette rays, whose distance is fitted to the ranges in closed form;
- a *box* of which one side shows, up to both silhouette rays; or
- a *box* of which two sides show, two perpendicular lines fitted to the points on both sides of a corner. The best
  heading for each corner is an eigenvector, the corner the best of all.

The simplest that explains the points is taken. A depth that does not show is that of the other boxes in the scan, or
else the box is a square. What the scan's whole segments have in common, *the pooled footprint*, is for the rest of the
scan: robots that are partly hidden or have too few points.

Poses, sights and edges are those of ``footprint_geometry`` and ``footprint_fit``.
"""

from __future__ import annotations

import numpy as np

from triform.control.footprint_geometry import TWO_POINTS
from triform.control.segments import MIN_FITTED, MIN_POINTS, STRAIGHT, TOLERANCE, breaks, find_edges, notch_depth
from triform.kernels import kernel
from triform.types import Body

#: Least and largest estimate of a robot's side or diameter [m]; what is larger is no robot.
SIZES = (0.06, 0.60)
#: Half the size of robots of whom a scan shows none whole [m].
USUAL_RADIUS = 0.15
#: Kinds of estimates.
NOTHING, DISC, ONE_SIDE, TWO_SIDES = 0, 1, 2, 3
#: A shape explains points as well as a less simple one up to this share and this much of root mean squares [m].
SIMPLER_SHARE, SIMPLER_SLACK = 1.3, 0.004
#: A ray along a side at a smaller sine than this says nothing about its end.
GRAZING_SINE = 0.05


@kernel
def fit_disc(points, count, edges, pose):
    """Fit the disc that touches both silhouette rays.

    At an angle ``t`` off the centre's bearing, a disc of distance D that the observer sees under the half angle ``h``
    has the range ``D (cos t - sqrt(sin(h)^2 - sin(t)^2))``: linear in D, which has least squares in closed form.

    Args:
        points: Points counter-clockwise [m], shape (>= count, 2).
        count: Number of points.
        edges: Clockwise, then counter-clockwise silhouette, both seen, see ``improve_pose``.
        pose: Centre to write [m], with heading 0, shape (3,).

    Returns:
        (root mean square of the points' distances from the circle [m], diameter [m]).
    """
    half_angle = 0.5 * ((edges[1, 0] - edges[0, 0]) % (2.0 * np.pi))
    bearing = edges[0, 0] + half_angle
    sine = np.sin(half_angle)
    above = below = 0.0
    for i in range(count):
        angle = np.arctan2(points[i, 1], points[i, 0]) - bearing
        share = np.cos(angle) - np.sqrt(max(sine * sine - np.sin(angle) ** 2, 0.0))
        above += share * np.hypot(points[i, 0], points[i, 1])
        below += share * share
    distance = above / below
    radius = distance * sine
    pose[0], pose[1], pose[2] = distance * np.cos(bearing), distance * np.sin(bearing), 0.0
    total = 0.0
    for i in range(count):
        total += (np.hypot(points[i, 0] - pose[0], points[i, 1] - pose[1]) - radius) ** 2
    return np.sqrt(total / count), 2.0 * radius


@kernel
def _scatter(moments, count, out):
    """Write the scatter (xx, xy, yy) about their mean of ``count`` points with moments (x, y, xx, xy, yy)."""
    out[0] = moments[2] - moments[0] * moments[0] / count
    out[1] = moments[3] - moments[0] * moments[1] / count
    out[2] = moments[4] - moments[1] * moments[1] / count


@kernel
def find_corner(points, count, first, last):
    """Fit two perpendicular lines to the first points and the others, for the best of ``first <= k < last``.

    With the scatters ``S`` of the first k points and ``T`` of the others about their means, lines with normals n and Jn
    (J turns by a right angle) have squared distances ``n' (S + J' T J) n``: least for an eigenvector.

    Args:
        points: Points [m], shape (>= count, 2).
        count: Number of points.
        first: Least number of points on the first line; ``count`` for a single line.
        last: That number is smaller than this.

    Returns:
        (number of points on the first line, its direction [rad], root mean square of the points' distances [m]).
    """
    whole, early, late = np.zeros(5), np.zeros(5), np.empty(5)
    scatter, other = np.empty(3), np.zeros(3)
    # Moments about the first point lose no digits.
    origin_x, origin_y = points[0, 0], points[0, 1]
    for i in range(count):
        x, y = points[i, 0] - origin_x, points[i, 1] - origin_y
        for m, value in enumerate((x, y, x * x, x * y, y * y)):
            whole[m] += value
    corner, direction, best = 0, 0.0, np.inf
    for k in range(1, last):
        x, y = points[k - 1, 0] - origin_x, points[k - 1, 1] - origin_y
        for m, value in enumerate((x, y, x * x, x * y, y * y)):
            early[m] += value
            late[m] = whole[m] - early[m]
        if k < first:
            continue
        _scatter(early, k, scatter)
        if k < count:
            _scatter(late, count - k, other)
        m_xx, m_xy, m_yy = scatter[0] + other[2], scatter[1] - other[1], scatter[2] + other[0]
        squares = 0.5 * (m_xx + m_yy - np.hypot(m_xx - m_yy, 2.0 * m_xy))
        if squares < best:
            corner, best = k, squares
            direction = 0.5 * np.arctan2(2.0 * m_xy, m_xx - m_yy)
    return corner, direction, np.sqrt(max(best, 0.0) / count)


@kernel
def _along(angle, height, t_x, t_y):
    """Where a ray from the origin meets the line at ``height`` along the normal of (t_x, t_y); ``NaN`` if it grazes."""
    d_x, d_y = np.cos(angle), np.sin(angle)
    rise = t_x * d_y - t_y * d_x
    if abs(rise) < GRAZING_SINE:
        return np.nan
    return height * (t_x * d_x + t_y * d_y) / rise


@kernel
def fit_one_side(points, count, edges, side):
    """Fit a side that ends at both silhouette rays.

    Args:
        points: Points counter-clockwise [m], shape (>= count, 2).
        count: Number of points.
        edges: Silhouette, see ``fit_disc``.
        side: Middle of the side [m], and the unit vector away from the observer, to write, shape (4,).

    Returns:
        (root mean square of the points' distances from the side [m], length of the side [m], ``NaN`` if it has none).
    """
    _, direction, cost = find_corner(points, count, count, count + 1)
    t_x, t_y = np.cos(direction), np.sin(direction)
    height = t_x * points[:count, 1].mean() - t_y * points[:count, 0].mean()
    start, end = _along(edges[0, 0], height, t_x, t_y), _along(edges[1, 0], height, t_x, t_y)
    middle, away = 0.5 * (start + end), np.sign(height)
    side[0], side[1] = middle * t_x - height * t_y, middle * t_y + height * t_x
    side[2], side[3] = -away * t_y, away * t_x
    return cost, abs(end - start)


@kernel
def fit_two_sides(points, count, edges, pose):
    """Fit a box of which two sides show: from one silhouette ray to the corner, and on to the other.

    Args:
        points: Points counter-clockwise [m], shape (>= count, 2), at least ``MIN_FITTED``.
        count: Number of points.
        edges: Silhouette, see ``fit_disc``.
        pose: Centre [m] and direction of the clockwise side [rad] to write, shape (3,).

    Returns:
        (root mean square of the points' distances from the sides [m], length of the clockwise side, length of the other
        [m]); the first is ``inf`` if no box has such sides.
    """
    corner, direction, cost = find_corner(points, count, 2, count - 1)
    t_x, t_y = np.cos(direction), np.sin(direction)
    height = t_x * points[:corner, 1].mean() - t_y * points[:corner, 0].mean()
    other = t_x * points[corner:count, 0].mean() + t_y * points[corner:count, 1].mean()
    start = _along(edges[0, 0], height, t_x, t_y)
    # Along the normal (-t_y, t_x), the clockwise side of which points back along t.
    end = _along(edges[1, 0], -other, -t_y, t_x)
    length, width = np.sign(other) * (start - other), np.sign(height) * (end - height)
    along, across = 0.5 * (start + other), 0.5 * (end + height)
    pose[0], pose[1], pose[2] = along * t_x - across * t_y, along * t_y + across * t_x, direction
    # Both sides reach away from the observer; NaN fails too.
    return (cost if length > 0.0 and width > 0.0 else np.inf), length, width


@kernel
def _is_size(length):
    return SIZES[0] <= length <= SIZES[1]


@kernel
def _estimate(points, count, edges, noise, pose, side):
    """Write the simplest shape that explains a whole segment; return its kind, length and width [m].

    A disc and two sides write ``pose``, one side writes ``side``; the width of one side is unknown, ``NaN``. Few points
    are a disc.
    """
    box_pose = np.empty(3)
    side_cost = box_cost = np.inf
    side_length = length = width = 0.0
    disc_cost, diameter = fit_disc(points, count, edges, pose)
    if not _is_size(diameter):
        disc_cost = np.inf
    if count >= MIN_FITTED:
        side_cost, side_length = fit_one_side(points, count, edges, side)
        if not _is_size(side_length):
            side_cost = np.inf
        box_cost, length, width = fit_two_sides(points, count, edges, box_pose)
        if not (_is_size(length) and _is_size(width)):
            box_cost = np.inf
    best = min(disc_cost, side_cost, box_cost)
    if best > TOLERANCE + noise:
        return NOTHING, 0.0, 0.0
    enough = SIMPLER_SHARE * best + SIMPLER_SLACK
    if disc_cost <= enough:
        return DISC, diameter, diameter
    if side_cost <= enough:
        return ONE_SIDE, side_length, np.nan
    pose[:] = box_pose
    return TWO_SIDES, length, width


@kernel
def _pool(kinds, sizes, found):
    """Return the pooled footprint of ``found`` estimates of the kinds (N,) and the sizes (N, 2)."""
    discs, boxes = sizes[:found][kinds[:found] == DISC], sizes[:found][kinds[:found] == TWO_SIDES]
    sides = sizes[:found][kinds[:found] == ONE_SIDE]
    if found == 0:
        return Body(USUAL_RADIUS, USUAL_RADIUS, True)
    if 2 * len(discs) >= found:
        radius = 0.5 * np.median(discs[:, 0])
        return Body(radius, radius, True)
    if len(boxes) == 0:
        half = 0.5 * np.median(sides[:, 0])
        return Body(half, half, False)
    longer = np.maximum(boxes[:, 0], boxes[:, 1])
    shorter = np.minimum(boxes[:, 0], boxes[:, 1])
    return Body(0.5 * np.median(longer), 0.5 * np.median(shorter), False)


@kernel
def _hidden_depth(length, pooled):
    """Return the other size of a box of which a side of this length shows [m]."""
    if pooled.is_circle:
        return length
    longer, shorter = 2.0 * pooled.half_length, 2.0 * pooled.half_width
    return shorter if abs(length - longer) <= abs(length - shorter) else longer


@kernel
def take_whole_robots(sight, rays, points, count, centres):
    """Find the robots that are seen whole, and take their points away.

    Args:
        sight: The whole scan.
        rays: Ray of each point, shape (>= count,); those of the other points are moved to its front.
        points: Points counter-clockwise [m], shape (>= count, 2); likewise.
        count: Number of points.
        centres: Centres to write [m], shape (>= count / 3, 2).

    Returns:
        (number of robots, number of other points, pooled footprint).
    """
    most = count // MIN_POINTS + 1
    kinds, sizes, sides = np.empty(most, dtype=np.int64), np.empty((most, 2)), np.empty((most, 4))
    edges, pose = np.empty((2, 2)), np.empty(3)
    found = others = begin = 0
    for end in range(1, count + 1):
        if end < count and not breaks(sight, rays[end - 1], rays[end]):
            continue
        first, begin = begin, end
        piece, size = points[first:end], end - first
        kind, length, width = NOTHING, 0.0, 0.0
        find_edges(sight, rays, first, end, edges)
        whole = not (np.isnan(edges[0, 0]) or np.isnan(edges[1, 0])) and size >= MIN_POINTS
        # A robot covers less than half of what is around its observer; the disc has no tangents otherwise.
        whole = whole and (edges[1, 0] - edges[0, 0]) % (2.0 * np.pi) < np.pi
        if whole and notch_depth(piece, size)[0] <= STRAIGHT + TWO_POINTS * sight.noise:
            kind, length, width = _estimate(piece, size, edges, sight.noise, pose, sides[found])
        if kind != NOTHING:
            kinds[found], sizes[found, 0], sizes[found, 1] = kind, length, width
            centres[found] = pose[:2]
            found += 1
            continue
        for i in range(first, end):
            rays[others] = rays[i]
            points[others] = points[i]
            others += 1
    pooled = _pool(kinds, sizes, found)
    for i in range(found):
        if kinds[i] == ONE_SIDE:
            depth = _hidden_depth(sizes[i, 0], pooled)
            centres[i] = sides[i, :2] + 0.5 * depth * sides[i, 2:]
    return found, others, pooled
