"""How good a triangulation is: the measures that need nothing but positions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from triform.geometry.cells import smallest_distance_of, squared_distance
from triform.geometry.gabriel import checked_points, gabriel_lists, per_world
from triform.kernels import kernel
from triform.types import BoolArray, FloatArray, IntArray, converted, require

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
def _listed_errors(positions, offsets, neighbours, distance):
    """Mean relative edge error, worst relative edge error and number of edges; NaN without edges."""
    total = 0.0
    worst = 0.0
    edges = 0
    for i in range(offsets.shape[0] - 1):
        for k in range(offsets[i], offsets[i + 1]):
            if neighbours[k] < i:
                error = abs(np.sqrt(squared_distance(positions, i, neighbours[k])) - distance) / distance
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
    distance, max_range, positions, active, error, edges_out, connected, strict, compactness, first, last
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
def _edge_error_worlds(distance, max_range, positions, active, error, first, last):
    for b in range(first, last):
        offsets, neighbours = gabriel_lists(positions[b], active[b], max_range)
        error[b] = _listed_errors(positions[b], offsets, neighbours, distance)[0]


@kernel
def _smallest_distances(positions, active, smallest, first, last):
    for b in range(first, last):
        smallest[b] = smallest_distance_of(positions[b], active[b])


def assess(
    positions: FloatArray, distance: float = 1.0, max_range: float = np.inf, active: BoolArray | None = None
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
    require(converted("distance", distance, float) > 0, f"distance is {distance} m; it must be positive")
    points, mask = checked_points(positions, active, max_range)
    kernel = partial(_assess_worlds, float(distance), float(max_range))
    return Quality(*per_world(kernel, points, mask, np.float64, np.int64, np.bool_, np.bool_, np.float64))


def edge_error(
    positions: FloatArray, distance: float = 1.0, max_range: float = np.inf, active: BoolArray | None = None
) -> FloatArray:
    """Mean relative edge error ``E_g / d*`` alone, for long series; arguments and errors as ``assess``."""
    require(converted("distance", distance, float) > 0, f"distance is {distance} m; it must be positive")
    points, mask = checked_points(positions, active, max_range)
    return per_world(partial(_edge_error_worlds, float(distance), float(max_range)), points, mask, np.float64)[0]


def list_triangles(positions: FloatArray, graph: BoolArray, distance: float = 1.0) -> tuple[IntArray, BoolArray]:
    """Return the triangles of one graph, and which of them are closed: all edges within 10 % of ``d*``.

    Args:
        positions: Positions [m], shape (N, 2).
        graph: Its edges, shape (N, N).
        distance: Prescribed neighbour distance d* [m].

    Returns:
        Triangles as growing indices of robots, shape (K, 3), and flags, shape (K,).
    """
    first, second = np.nonzero(np.triu(graph, 1))
    # A third robot counts once: as the last of its triangle.
    rows, thirds = np.nonzero(graph[first] & graph[second])
    last = thirds > second[rows]
    corners = np.column_stack([first[rows[last]], second[rows[last]], thirds[last]])
    places = positions[corners]
    lengths = np.linalg.norm(places - np.roll(places, 1, axis=1), axis=-1)
    return corners, (np.abs(lengths - distance) < EDGE_TOLERANCE * distance).all(axis=1)


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
    return per_world(_smallest_distances, *checked_points(positions, active, np.inf), np.float64)[0]
