"""Gabriel proximity graph.

Two robots are neighbours iff no other robot lies strictly inside the circle whose diameter joins them. Robot k
lies strictly inside the circle over i and j iff it sees them under an obtuse angle,
``(p_i - p_k) . (p_j - p_k) < 0``; that form needs no square root and no midpoint.

What follows from "strictly": robots on the circle do not block an edge, so both diagonals of an exact square are
edges; a robot that coincides with i or j blocks nothing; coincident robots are neighbours.

Small teams are treated by that definition, larger ones by cells in time linear in N; the edges are the same ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from triform.geometry.cells import SMALL_TEAM, extended, list_cells, make_cells
from triform.geometry.gabriel_kernels import list_neighbours, make_workspace
from triform.kernels import kernel
from triform.threads import in_parts
from triform.types import BoolArray, ConfigurationError, FloatArray, as_array, converted, require

#: Robots that keep a thread busy for a few milliseconds, in small teams and in large ones.
ROBOTS_PER_THREAD = 10_000


@kernel
def _fill_graph(positions, active, limit, out):
    """Write the graph by its definition."""
    for i in range(active.shape[0]):
        out[i, i] = False
        for j in range(i):
            out[i, j] = out[j, i] = _are_neighbours(positions, active, i, j, limit)


@kernel
def _are_neighbours(positions, active, i, j, limit):
    """Whether two robots are Gabriel neighbours, by the definition; ``limit`` is the squared longest edge [m^2]."""
    if not (active[i] and active[j]):
        return False
    x_i, y_i = positions[i, 0], positions[i, 1]
    x_j, y_j = positions[j, 0], positions[j, 1]
    if (x_i - x_j) * (x_i - x_j) + (y_i - y_j) * (y_i - y_j) > limit:
        return False
    for k in range(positions.shape[0]):
        if k != i and k != j and active[k]:
            x_k, y_k = positions[k, 0], positions[k, 1]
            if (x_i - x_k) * (x_j - x_k) + (y_i - y_k) * (y_j - y_k) < 0.0:
                return False
    return True


@kernel
def gabriel_lists(positions, active, max_range):
    """Gabriel graph of one world as lists of neighbours.

    Args:
        positions: Positions [m], shape (N, 2) or (N, 3) with anything in the third column.
        active: Robots that exist, shape (N,); others neither have nor block edges.
        max_range: Pairs farther apart are no neighbours [m].

    Returns:
        Offsets of shape (N + 1,) and neighbours of shape (2 E,): those of robot i are
        ``neighbours[offsets[i] : offsets[i + 1]]``, in growing order.
    """
    robots = active.shape[0]
    limit = max_range * max_range
    offsets = np.zeros(robots + 1, dtype=np.int64)
    filled = 0
    if robots <= SMALL_TEAM:
        graph = np.empty((robots, robots), dtype=np.bool_)
        _fill_graph(positions, active, limit, graph)
        few = np.empty(robots * robots, dtype=np.int64)
        for i in range(robots):
            for j in range(robots):
                if graph[i, j]:
                    few[filled] = j
                    filled += 1
            offsets[i + 1] = filled
        return offsets, few[:filled]
    listed = np.empty((8 * robots + 8, 1), dtype=np.int64)
    world = make_cells(positions, active)
    order, _, parts, _ = world
    workspace = make_workspace(order.shape[0])
    begins = np.empty(order.shape[0], dtype=np.int64)
    ends = np.empty(order.shape[0] + 1, dtype=np.int64)
    in_cell = np.empty((64, 1), dtype=np.int64)
    for cell in list_cells(world):
        in_cell = list_neighbours(world, cell, limit, workspace, in_cell, ends)
        for own in range(parts[cell, 0], parts[cell, 1]):
            k = own - parts[cell, 0]
            begins[own] = filled + ends[k]
            offsets[order[own] + 1] = ends[k + 1] - ends[k]
        count = ends[parts[cell, 1] - parts[cell, 0]]
        listed = extended(listed, filled + count)
        for k in range(count):
            listed[filled + k, 0] = in_cell[k, 0]
        filled += count
    for i in range(robots):
        offsets[i + 1] += offsets[i]
    neighbours = np.empty(filled, dtype=np.int64)
    for own in range(order.shape[0]):
        first = offsets[order[own]]
        for k in range(offsets[order[own] + 1] - first):
            neighbours[first + k] = listed[begins[own] + k, 0]
    return offsets, neighbours


@kernel
def gabriel_into(positions, active, max_range, out):
    """Write the Gabriel graph of one world as a matrix; allocates nothing for up to ``SMALL_TEAM`` robots.

    Args:
        positions: Positions [m], shape (N, 2) or (N, 3) with anything in the third column.
        active: Robots that exist, shape (N,); others neither have nor block edges.
        max_range: Pairs farther apart are no neighbours [m].
        out: Adjacency to fill, bool, shape (N, N).
    """
    robots = active.shape[0]
    if robots > SMALL_TEAM:
        out[:] = False
        offsets, neighbours = gabriel_lists(positions, active, max_range)
        for i in range(robots):
            for k in range(offsets[i], offsets[i + 1]):
                out[i, neighbours[k]] = True
    else:
        _fill_graph(positions, active, max_range * max_range, out)


@kernel
def _gabriel_worlds(max_range, positions, active, out, first, last):
    for b in range(first, last):
        gabriel_into(positions[b], active[b], max_range, out[b])


def gabriel_graph(positions: FloatArray, max_range: float = np.inf, active: BoolArray | None = None) -> BoolArray:
    """Gabriel graph of every world as a matrix.

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
    matrix = (points.shape[-2], points.shape[-2])
    (graph,) = per_world(partial(_gabriel_worlds, float(max_range)), points, mask, np.bool_, shape=matrix)
    return graph


def per_world(
    kernel: Callable[..., object], points: FloatArray, mask: BoolArray, *dtypes: DTypeLike, shape: tuple[int, ...] = ()
) -> list[NDArray[Any]]:
    """Call ``kernel(points, mask, *results, first, last)`` for all worlds, side by side where that pays.

    Args:
        kernel: Fills the results of the worlds ``first <= b < last`` from points (B, N, 2) and mask (B, N).
        points: Positions [m], shape (..., N, 2), from ``checked_points``.
        mask: Robots that exist, shape (..., N).
        *dtypes: Type of every result.
        shape: Shape of one world's result.

    Returns:
        The results, each of shape (..., *shape).
    """
    *lead, robots, _ = points.shape
    count = math.prod(lead)
    worlds, masks = points.reshape(count, robots, 2), mask.reshape(count, robots)
    results = [np.empty((count, *shape), dtype) for dtype in dtypes]
    in_parts(lambda first, last: kernel(worlds, masks, *results, first, last), count, count * robots, ROBOTS_PER_THREAD)
    return [result.reshape((*lead, *shape)) for result in results]


def checked_points(positions: FloatArray, active: BoolArray | None, max_range: float) -> tuple[FloatArray, BoolArray]:
    """Return contiguous positions (..., N, 2) and a mask (..., N), or say what is wrong with them.

    Raises:
        ConfigurationError: If the shapes do not fit, the position of an active robot is not finite or ``max_range``
            is negative.
    """
    require(converted("max_range", max_range, float) >= 0, f"max_range is {max_range} m; it must not be negative")
    points = as_array("positions", positions)
    require(points.ndim >= 2 and points.shape[-1] == 2, f"positions have shape {points.shape}; (..., N, 2) is needed")
    present = as_array("flags of active robots", True if active is None else active, np.bool_)
    try:
        mask = np.ascontiguousarray(np.broadcast_to(present, points.shape[:-1]))
    except ValueError:
        raise ConfigurationError(f"active has shape {present.shape}; {points.shape[:-1]} is needed") from None
    require(bool(np.isfinite(points[mask]).all()), "positions of active robots must be finite")
    return points, mask
