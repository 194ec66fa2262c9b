"""How good a triangulation is: the measures that need nothing but positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from triform.geometry.gabriel import PAIRS_PER_THREAD, checked_points, gabriel_into
from triform.threads import threads_for
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


@njit(cache=True, nogil=True)
def _edge_error(positions, graph, distance):  # type: ignore[no-untyped-def]
    """Mean relative edge error and worst relative edge error of one world; NaN without edges."""
    total = 0.0
    worst = 0.0
    edges = 0
    for i in range(positions.shape[0]):
        for j in range(i):
            if graph[i, j]:
                dx = positions[i, 0] - positions[j, 0]
                dy = positions[i, 1] - positions[j, 1]
                error = abs(np.sqrt(dx * dx + dy * dy) - distance) / distance
                total += error
                worst = max(worst, error)
                edges += 1
    if edges == 0:
        return np.nan, np.nan, edges
    return total / edges, worst, edges


@njit(cache=True, nogil=True)
def _count_reached(graph, active):  # type: ignore[no-untyped-def]
    """Number of active robots and how many of them the first one reaches over the graph."""
    robots = graph.shape[0]
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
        for j in range(robots):
            if graph[i, j] and not seen[j]:
                seen[j] = True
                stack[top] = j
                top += 1
    return count, reached


@njit(cache=True, nogil=True)
def _triangles(graph):  # type: ignore[no-untyped-def]
    """Number of 3-cycles and whether every edge belongs to one."""
    robots = graph.shape[0]
    triangles = 0
    covered = True
    for i in range(robots):
        for j in range(i):
            if graph[i, j]:
                common = 0
                for k in range(robots):
                    if graph[i, k] and graph[j, k]:
                        common += 1
                triangles += common
                if common == 0:
                    covered = False
    return triangles // 3, covered


@njit(cache=True, nogil=True, parallel=True)
def _assess_worlds(  # type: ignore[no-untyped-def]
    positions, active, distance, max_range, error, edges_out, connected, strict, compactness
):
    robots = positions.shape[1]
    for b in prange(positions.shape[0]):
        graph = np.empty((robots, robots), dtype=np.bool_)
        gabriel_into(positions[b], active[b], max_range, graph)
        mean, worst, edges = _edge_error(positions[b], graph, distance)
        count, reached = _count_reached(graph, active[b])
        triangles, covered = _triangles(graph)
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


@njit(cache=True, nogil=True, parallel=True)
def _edge_error_worlds(positions, active, distance, max_range, out):  # type: ignore[no-untyped-def]
    robots = positions.shape[1]
    for b in prange(positions.shape[0]):
        graph = np.empty((robots, robots), dtype=np.bool_)
        gabriel_into(positions[b], active[b], max_range, graph)
        out[b] = _edge_error(positions[b], graph, distance)[0]


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
    with threads_for(error.size * robots**2, PAIRS_PER_THREAD):
        _assess_worlds(
            points.reshape(error.size, robots, 2),
            mask.reshape(error.size, robots),
            distance,
            max_range,
            error.reshape(-1),
            edges.reshape(-1),
            connected.reshape(-1),
            strict.reshape(-1),
            compactness.reshape(-1),
        )
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
    with threads_for(out.size * robots**2, PAIRS_PER_THREAD):
        _edge_error_worlds(
            points.reshape(out.size, robots, 2), mask.reshape(out.size, robots), distance, max_range, out.reshape(-1)
        )
    return out
