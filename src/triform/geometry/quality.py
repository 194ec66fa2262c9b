"""How good a triangulation is: the measures that need nothing but positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from triform.geometry.cells import SMALL_TEAM, smallest_distance_of
from triform.geometry.gabriel import ROBOTS_PER_THREAD, are_neighbours, checked_points, gabriel_lists
from triform.kernels import kernel
from triform.threads import in_parts
from triform.types import BoolArray, FloatArray, IntArray, require

#: An edge is right when its length is within this share of the prescribed distance.
EDGE_TOLERANCE = 0.1


@dataclass(frozen=True)
class Quality:
    """Measures of formations; every array has the leading axes of the positions.

    Attributes:
        edge_error: Mean over Gabriel edges of ``|length - d*| / d*``; ``NaN`` where there is no edge.
        edges: Number of Gabriel edges.
        connected: Whether the graph is connected (one robot is, none is not).
        strict: Whether the formation is a triangulation: connected, every edge within 10 % of ``d*`` and in a
            triangle, every bounded face a triangle. Needs at least three robots.
        compactness: Edges over the most unit contacts that N points can have, floor(3N - sqrt(12N - 3));
            ``NaN`` for fewer than two robots.
    """

    edge_error: FloatArray
    edges: IntArray
    connected: BoolArray
    strict: BoolArray
    compactness: FloatArray


@kernel
def _relative_error(positions, i, j, distance):
    """Relative error of the length of one edge."""
    dx = positions[i, 0] - positions[j, 0]
    dy = positions[i, 1] - positions[j, 1]
    return abs(np.sqrt(dx * dx + dy * dy) - distance) / distance


@kernel
def _edge_error(positions, active, distance, max_range):
    """Mean relative edge error of one world; NaN without edges."""
    if active.shape[0] > SMALL_TEAM:
        offsets, neighbours = gabriel_lists(positions, active, max_range)
        return _listed_errors(positions, offsets, neighbours, distance)[0]
    total = 0.0
    edges = 0
    for i in range(active.shape[0]):
        for j in range(i):
            if are_neighbours(positions, active, i, j, max_range * max_range):
                total += _relative_error(positions, i, j, distance)
                edges += 1
    return total / edges if edges > 0 else np.nan


@kernel
def _listed_errors(positions, offsets, neighbours, distance):
    """Mean relative edge error, worst relative edge error and number of edges; NaN without edges."""
    total = 0.0
    worst = 0.0
    edges = 0
    for i in range(offsets.shape[0] - 1):
        for k in range(offsets[i], offsets[i + 1]):
            if neighbours[k] < i:
                error = _relative_error(positions, i, neighbours[k], distance)
                total += error
                worst = max(worst, error)
                edges += 1
    if edges == 0:
        return np.nan, np.nan, edges
    return total / edges, worst, edges


@kernel
def _count_reached(offsets, neighbours, active):
    """Number of active robots and how many of them the first one reaches over the graph."""
    robots = active.shape[0]
    seen = np.zeros(robots, dtype=np.bool_)
    stack = np.empty(robots, dtype=np.int64)
    count = 0
    top = 0
    for i in range(robots):
        if active[i]:
            if count == 0:
                seen[i] = True
                stack[0] = i
                top = 1
            count += 1
    reached = 0
    while top > 0:
        top -= 1
        i = stack[top]
        reached += 1
        for j in neighbours[offsets[i] : offsets[i + 1]]:
            if not seen[j]:
                seen[j] = True
                stack[top] = j
                top += 1
    return count, reached


@kernel
def _count_common(first, second):
    """How many numbers two growing lists have in common."""
    common = 0
    i = j = 0
    while i < first.shape[0] and j < second.shape[0]:
        if first[i] < second[j]:
            i += 1
        elif first[i] > second[j]:
            j += 1
        else:
            common += 1
            i += 1
            j += 1
    return common


@kernel
def _triangles(offsets, neighbours):
    """Number of 3-cycles and whether every edge belongs to one."""
    triangles = 0
    covered = True
    for i in range(offsets.shape[0] - 1):
        own = neighbours[offsets[i] : offsets[i + 1]]
        for j in own:
            if j < i:
                common = _count_common(own, neighbours[offsets[j] : offsets[j + 1]])
                triangles += common
                covered = covered and common > 0
    return triangles // 3, covered


@kernel
def _assess_worlds(
    positions, active, distance, max_range, error, edges_out, connected, strict, compactness, first, last
):
    for b in range(first, last):
        offsets, neighbours = gabriel_lists(positions[b], active[b], max_range)
        mean, worst, edges = _listed_errors(positions[b], offsets, neighbours, distance)
        count, reached = _count_reached(offsets, neighbours, active[b])
        triangles, covered = _triangles(offsets, neighbours)
        error[b] = mean
        edges_out[b] = edges
        connected[b] = count > 0 and reached == count
        # Euler: a connected planar graph has E - N + 1 bounded faces; all are triangles iff there are as
        # many 3-cycles, because an empty 3-cycle is a face and a Gabriel triangle is empty.
        strict[b] = (
            connected[b] and count >= 3 and worst < EDGE_TOLERANCE and covered and triangles == edges - count + 1
        )
        compactness[b] = np.nan
        if count >= 2:
            compactness[b] = edges / np.floor(3 * count - np.sqrt(12.0 * count - 3))


@kernel
def _edge_error_worlds(positions, active, distance, max_range, out, first, last):
    for b in range(first, last):
        out[b] = _edge_error(positions[b], active[b], distance, max_range)


@kernel
def _smallest_distances(positions, active, out, first, last):
    for b in range(first, last):
        out[b] = smallest_distance_of(positions[b], active[b])


def assess(
    positions: FloatArray,
    distance: float = 1.0,
    max_range: float = np.inf,
    active: BoolArray | None = None,
) -> Quality:
    """Measure formations on their Gabriel graph.

    Args:
        positions: Positions [m], shape (..., N, 2).
        distance: Prescribed neighbour distance d* [m].
        max_range: Longest edge of the graph [m].
        active: Robots that exist, shape (..., N); all by default.

    Returns:
        The measures, arrays of shape (...).

    Raises:
        ConfigurationError: If the positions are malformed or ``distance`` is not positive.
    """
    require(distance > 0, f"distance is {distance} m; it must be positive")
    points, mask = checked_points(positions, active, max_range)
    lead = points.shape[:-2]
    robots = points.shape[-2]
    error = np.empty(lead)
    edges = np.empty(lead, dtype=np.int64)
    connected = np.empty(lead, dtype=np.bool_)
    strict = np.empty(lead, dtype=np.bool_)
    compactness = np.empty(lead)
    worlds, masks = points.reshape(error.size, robots, 2), mask.reshape(error.size, robots)
    columns = [column.reshape(-1) for column in (error, edges, connected, strict, compactness)]
    in_parts(
        lambda first, last: _assess_worlds(worlds, masks, distance, max_range, *columns, first, last),
        error.size, error.size * robots, ROBOTS_PER_THREAD,
    )  # fmt: skip
    return Quality(error, edges, connected, strict, compactness)


def edge_error(
    positions: FloatArray,
    distance: float = 1.0,
    max_range: float = np.inf,
    active: BoolArray | None = None,
) -> FloatArray:
    """Mean relative edge error ``E_g / d*`` alone, for long series; arguments and errors as ``assess``."""
    require(distance > 0, f"distance is {distance} m; it must be positive")
    points, mask = checked_points(positions, active, max_range)
    robots = points.shape[-2]
    out = np.empty(points.shape[:-2])
    worlds, masks, flat = points.reshape(out.size, robots, 2), mask.reshape(out.size, robots), out.reshape(-1)
    in_parts(
        lambda first, last: _edge_error_worlds(worlds, masks, distance, max_range, flat, first, last),
        out.size, out.size * robots, ROBOTS_PER_THREAD,
    )  # fmt: skip
    return out


def smallest_distance(positions: FloatArray, active: BoolArray | None = None) -> FloatArray:
    """Smallest distance between two robots of every formation [m].

    Args:
        positions: Positions [m], shape (..., N, 2).
        active: Robots that exist, shape (..., N); all by default.

    Returns:
        Distances, shape (...); infinite where there are not two robots.

    Raises:
        ConfigurationError: If the positions are malformed.
    """
    points, mask = checked_points(positions, active, np.inf)
    robots = points.shape[-2]
    out = np.empty(points.shape[:-2])
    worlds, masks, flat = points.reshape(out.size, robots, 2), mask.reshape(out.size, robots), out.reshape(-1)
    in_parts(
        lambda first, last: _smallest_distances(worlds, masks, flat, first, last),
        out.size, out.size * robots, ROBOTS_PER_THREAD,
    )  # fmt: skip
    return out
