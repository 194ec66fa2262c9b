"""Kernels that cut one scan into segments and turn segments into robots.

Everything is in the observer's frame; footprints, poses and sights are those of
``_footprint_geometry``, silhouette edges those of ``_footprint_fit``.
"""

from __future__ import annotations

import numpy as np

from triform.control.footprint_fit import fit_footprint, push_centroid
from triform.control.footprint_geometry import TWO_POINTS
from triform.kernels import kernel

#: Fewer points than this are noise; fewer than ``MIN_FITTED`` are too few to fit a pose.
MIN_POINTS = 3
MIN_FITTED = 5
#: Largest root mean cost at which points count as one robot [m].
TOLERANCE = 0.035
#: A segment breaks between neighbours farther apart than a surface at this grazing angle explains [rad] ...
GRAZING = np.deg2rad(10.0)
#: ... plus an allowance for noise, and within these limits [m].
GAP_NOISE = 0.05
GAP_LIMITS = (0.08, 0.16)
#: An object that is seen whole but is narrower than this share of a robot's narrow side is no robot.
NARROWEST = 0.7
#: Two neighbouring surfaces touch if their ranges differ by less than this [m].
TOUCHING = 0.03
#: Points whose RMS distance from a line is smaller lie on it; a wall is a line longer than a robot by this slack [m].
STRAIGHT = 0.03
SPAN_SLACK = 0.05


@kernel
def collect_points(ranges, sight, rays, points):
    """Clean one scan and list its points counter-clockwise, starting at a gap if there is one.

    Args:
        ranges: Measured ranges [m], shape (R,).
        sight: The whole scan, whose clean ranges are written.
        rays: Ray of each point to write, shape (R,).
        points: Points to write [m], shape (R, 2).

    Returns:
        Number of points.
    """
    clean, directions, range_max = sight.ranges, sight.directions, sight.range_max
    total = ranges.shape[0]
    count = 0
    for k in range(total):
        value = ranges[k]
        if value > range_max:
            clean[k] = np.inf
        elif value > 0.0:
            clean[k] = value
            rays[count] = k
            count += 1
        else:
            clean[k] = np.nan
    start = 0
    for i in range(count):
        if breaks(sight, rays[i - 1] if i else rays[count - 1], rays[i]):
            start = i
            break
    order = np.roll(rays[:count], -start)
    for i in range(count):
        rays[i] = order[i]
        for axis in range(2):
            points[i, axis] = clean[order[i]] * directions[order[i], axis]
    return count


@kernel
def breaks(sight, ray, other):
    """Whether two consecutive points are too far apart for one surface."""
    clean, directions = sight.ranges, sight.directions
    total = clean.shape[0]
    turn = 2.0 * np.pi / total * ((other - ray) % total)
    limit = min(clean[ray], clean[other]) * turn / np.sin(GRAZING) + GAP_NOISE
    limit = min(max(limit, GAP_LIMITS[0]), GAP_LIMITS[1]) + TWO_POINTS * sight.noise
    gap_x = clean[ray] * directions[ray, 0] - clean[other] * directions[other, 0]
    gap_y = clean[ray] * directions[ray, 1] - clean[other] * directions[other, 1]
    return gap_x * gap_x + gap_y * gap_y > limit * limit


@kernel
def silhouette_edge(sight, ray, previous, side, edge):
    """Write where the silhouette ends beside a segment's end: (angle, half gap) [rad], ``NaN`` if that is not seen.

    It is seen if the next ray that says anything goes clearly farther. It is not if that ray stops nearer (hidden) or
    at about the same range (touching), or if the surface could simply have left the range (cut).

    Args:
        sight: The whole scan.
        ray: Ray of the end point.
        previous: Ray of the point before the end, equal to ``ray`` if there is none.
        side: +1 for the counter-clockwise end, -1 for the clockwise one.
        edge: Result, shape (2,).
    """
    clean, angle_min, range_max = sight.ranges, sight.angle_min, sight.range_max
    total = clean.shape[0]
    increment = 2.0 * np.pi / total
    edge[0] = edge[1] = np.nan
    for k in range(1, total):
        beyond = clean[(ray + side * k) % total]
        if np.isnan(beyond):
            continue
        slope = max(clean[ray] - clean[previous], 0.0)
        cut = beyond == np.inf and clean[ray] + 1.5 * slope + TOUCHING + sight.noise > range_max
        if beyond > clean[ray] + TOUCHING + TWO_POINTS * sight.noise and not cut:
            edge[0] = angle_min + increment * (ray + 0.5 * side * k)
            edge[1] = 0.5 * increment * k
        return


@kernel
def find_edges(sight, rays, first, last, edges):
    """Write both silhouette edges of the points from index ``first`` up to before ``last``, shape (2, 2)."""
    inner_first, inner_last = min(first + 1, last - 1), max(last - 2, first)
    silhouette_edge(sight, rays[first], rays[inner_first], -1, edges[0])
    silhouette_edge(sight, rays[last - 1], rays[inner_last], 1, edges[1])


@kernel
def longest_span(footprint, noise):
    """Return the largest distance between two points of one robot, with slack for noise [m]."""
    a, b, round_ = footprint
    return (2.0 * a if round_ else 2.0 * np.hypot(a, b)) + SPAN_SLACK + TWO_POINTS * noise


@kernel
def span(points, count):
    """Return the largest distance between two points [m]."""
    longest = 0.0
    for i in range(count):
        for j in range(i):
            longest = max(longest, (points[i, 0] - points[j, 0]) ** 2 + (points[i, 1] - points[j, 1]) ** 2)
    return np.sqrt(longest)


@kernel
def notch_depth(points, count):
    """Return how far the points leave the chord between their ends, away from the observer [m], and where."""
    x, y = points[0, 0], points[0, 1]
    chord_x, chord_y = points[count - 1, 0] - x, points[count - 1, 1] - y
    length = max(np.hypot(chord_x, chord_y), 1e-9)
    n_x, n_y = -chord_y / length, chord_x / length
    if n_x * x + n_y * y < 0.0:
        n_x, n_y = -n_x, -n_y
    away, where = 0.0, 0
    for i in range(count):
        deviation = n_x * (points[i, 0] - x) + n_y * (points[i, 1] - y)
        if deviation > away:
            away, where = deviation, i
    return away, where


@kernel
def split_index(points, count, noise):
    """Where merged objects part: at a gap that stands out, else at the notch between two convex shapes.

    Returns:
        Number of points of the first part; 0 if nothing says that there are two.
    """
    if count < 2:
        return 0
    widest, total, where = 0.0, 0.0, 0
    for i in range(1, count):
        gap = np.hypot(points[i, 0] - points[i - 1, 0], points[i, 1] - points[i - 1, 1])
        total += gap
        if gap > widest:
            widest, where = gap, i
    if widest > TOUCHING + TWO_POINTS * noise and widest > 3.0 * (total - widest) / max(count - 2, 1):
        return where
    away, notch = notch_depth(points, count)
    return notch if away > STRAIGHT + TWO_POINTS * noise else 0


@kernel
def fit_segment(points, count, edges, footprint, sight, pose):
    """Fit the footprint, or guess from too few points; return the root mean cost [m], ``inf`` if no robot."""
    a, b, _ = footprint
    if count < MIN_POINTS or span(points, count) > longest_span(footprint, sight.noise):
        return np.inf
    visible = ((edges[1, 0] - edges[0, 0]) % (2.0 * np.pi)) * np.hypot(
        points[:count, 0].mean(), points[:count, 1].mean()
    )
    if visible < NARROWEST * 2.0 * min(a, b):
        return np.inf
    if count < MIN_FITTED:
        push_centroid(points, count, edges, footprint, pose)
        return TOLERANCE
    return fit_footprint(points, count, edges, footprint, sight, pose)


@kernel
def fit_line(points, count, line):
    """Write the line of least squared distances as (point, unit normal), shape (4,); return those distances' RMS."""
    x, y = points[:count, 0].mean(), points[:count, 1].mean()
    s_xx = s_xy = s_yy = 0.0
    for i in range(count):
        d_x, d_y = points[i, 0] - x, points[i, 1] - y
        s_xx += d_x * d_x
        s_xy += d_x * d_y
        s_yy += d_y * d_y
    along = 0.5 * np.arctan2(2.0 * s_xy, s_xx - s_yy)
    line[0], line[1], line[2], line[3] = x, y, -np.sin(along), np.cos(along)
    return line_distance(points, count, line)


@kernel
def line_distance(points, count, line):
    """Return the root mean square distance of points from a line [m]."""
    total = 0.0
    for i in range(count):
        total += ((points[i, 0] - line[0]) * line[2] + (points[i, 1] - line[1]) * line[3]) ** 2
    return np.sqrt(total / count)


@kernel
def find_wall(points, count, footprint, noise, line):
    """Whether a segment is straight and longer than any robot; its line is written to ``line``."""
    chord = np.hypot(points[count - 1, 0] - points[0, 0], points[count - 1, 1] - points[0, 1])
    return chord > longest_span(footprint, noise) and fit_line(points, count, line) < STRAIGHT + noise


@kernel
def looks_like_wall(points, count, edges, noise, walls, wall_count):
    """Whether the points may be a piece of a wall: on the line of a wall, or straight without a free edge."""
    for k in range(wall_count):
        if line_distance(points, count, walls[k]) < STRAIGHT + noise:
            return True
    hidden = np.isnan(edges[0, 0]) and np.isnan(edges[1, 0])
    return hidden and fit_line(points, count, np.empty(4)) < STRAIGHT + noise
