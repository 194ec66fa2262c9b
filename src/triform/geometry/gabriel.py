"""Gabriel proximity graph.

Two robots are neighbours iff no other robot lies strictly inside the circle whose diameter joins them. Robot k
lies strictly inside the circle over i and j iff it sees them under an obtuse angle,
``(p_i - p_k) . (p_j - p_k) < 0``; that form needs no square root and no midpoint.

What follows from "strictly": robots on the circle do not block an edge, so both diagonals of an exact square are
edges; a robot that coincides with i or j blocks nothing; coincident robots are neighbours.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from triform.threads import threads_for
from triform.types import BoolArray, ConfigurationError, FloatArray

#: Pairs of robots that keep a thread busy for a few milliseconds.
PAIRS_PER_THREAD = 100_000


@njit(cache=True, nogil=True)
def gabriel_into(positions, active, max_range, out):  # type: ignore[no-untyped-def]
    """Write the Gabriel graph of one world.

    Args:
        positions: Positions [m], shape (N, 2) or (N, 3) with anything in the third column.
        active: Robots that exist, shape (N,); others neither have nor block edges.
        max_range: Pairs farther apart are no neighbours [m].
        out: Adjacency to fill, bool, shape (N, N).
    """
    robots = positions.shape[0]
    limit = max_range * max_range
    for i in range(robots):
        out[i, i] = False
        for j in range(i):
            edge = active[i] and active[j]
            if edge:
                x_i, y_i = positions[i, 0], positions[i, 1]
                x_j, y_j = positions[j, 0], positions[j, 1]
                edge = (x_i - x_j) ** 2 + (y_i - y_j) ** 2 <= limit
            if edge:
                for k in range(robots):
                    if k == i or k == j or not active[k]:
                        continue
                    x_k, y_k = positions[k, 0], positions[k, 1]
                    if (x_i - x_k) * (x_j - x_k) + (y_i - y_k) * (y_j - y_k) < 0.0:
                        edge = False
                        break
            out[i, j] = edge
            out[j, i] = edge


@njit(cache=True, nogil=True, parallel=True)
def _gabriel_worlds(positions, active, max_range, out):  # type: ignore[no-untyped-def]
    for b in prange(positions.shape[0]):
        gabriel_into(positions[b], active[b], max_range, out[b])


def gabriel_graph(positions: FloatArray, max_range: float = np.inf, active: BoolArray | None = None) -> BoolArray:
    """Gabriel graph of every world.

    With a finite ``max_range`` the graph holds the edges of the full graph that are no longer than it. That is
    also what a robot finds from the robots within ``max_range`` of itself alone: whoever blocks one of its edges
    is nearer to it than the edge is long.

    Args:
        positions: Positions [m], shape (..., N, 2).
        max_range: Longest edge [m].
        active: Robots that exist, shape (..., N); all by default.

    Returns:
        Symmetric adjacency without self loops, bool, shape (..., N, N).

    Raises:
        ConfigurationError: If the shapes do not fit, a position is not finite or ``max_range`` is negative.
    """
    points, mask = checked_points(positions, active, max_range)
    robots = points.shape[-2]
    out = np.empty((*points.shape[:-2], robots, robots), dtype=np.bool_)
    worlds = points.reshape(math.prod(points.shape[:-2]), robots, 2)
    with threads_for(len(worlds) * robots**2, PAIRS_PER_THREAD):
        _gabriel_worlds(worlds, mask.reshape(len(worlds), robots), max_range, out.reshape(len(worlds), robots, robots))
    return out


def checked_points(positions: FloatArray, active: BoolArray | None, max_range: float) -> tuple[FloatArray, BoolArray]:
    """Return contiguous positions (..., N, 2) and a mask (..., N), or say what is wrong with them.

    Raises:
        ConfigurationError: If the shapes do not fit, the position of an active robot is not finite or ``max_range``
            is negative.
    """
    if not max_range >= 0:
        raise ConfigurationError(f"max_range is {max_range} m; it must not be negative")
    points = np.ascontiguousarray(positions, dtype=np.float64)
    if points.ndim < 2 or points.shape[-1] != 2:
        raise ConfigurationError(f"positions have shape {points.shape}; (..., N, 2) is needed")
    if active is None:
        mask = np.ones(points.shape[:-1], dtype=np.bool_)
    else:
        mask = np.ascontiguousarray(np.broadcast_to(active, points.shape[:-1]), dtype=np.bool_)
    if not np.isfinite(points[mask]).all():
        raise ConfigurationError("positions of active robots must be finite")
    return points, mask
