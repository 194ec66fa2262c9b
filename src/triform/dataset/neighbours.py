"""Where the other robots of a record are, seen from each: the truth behind a map."""

from __future__ import annotations

import numpy as np
from numba import njit

from triform.geometry import gabriel_into
from triform.types import FloatArray


@njit(cache=True, nogil=True)
def neighbours_into(poses, graph, out):  # type: ignore[no-untyped-def]
    """Write the other robots of one record in each robot's body frame.

    Args:
        poses: Poses [m, m, rad], shape (N, 3).
        graph: Which pairs are neighbours, bool, shape (N, N).
        out: (x [m], y [m], 1 if neighbour else 0) of the others, in order, shape (N, N - 1, 3).
    """
    robots = poses.shape[0]
    for i in range(robots):
        cos, sin = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        slot = 0
        for j in range(robots):
            if j != i:
                d_x, d_y = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
                out[i, slot, 0] = cos * d_x + sin * d_y
                out[i, slot, 1] = -sin * d_x + cos * d_y
                out[i, slot, 2] = 1.0 if graph[i, j] else 0.0
                slot += 1


@njit(cache=True, nogil=True)
def _neighbours(poses, sensing_range, out):  # type: ignore[no-untyped-def]
    robots = poses.shape[1]
    active = np.ones(robots, dtype=np.bool_)
    graph = np.empty((robots, robots), dtype=np.bool_)
    for e in range(poses.shape[0]):
        gabriel_into(poses[e], active, sensing_range, graph)
        neighbours_into(poses[e], graph, out[e])


def neighbours(poses: FloatArray, sensing_range: float) -> FloatArray:
    """The other robots in the body frame of each.

    Args:
        poses: Poses of E records [m, m, rad], shape (E, N, 3).
        sensing_range: Gabriel neighbours farther away do not count as such [m].

    Returns:
        (x [m], y [m], 1 if Gabriel neighbour else 0), shape (E * N, N - 1, 3).
    """
    records, robots = poses.shape[:2]
    out = np.empty((records, robots, robots - 1, 3))
    _neighbours(np.ascontiguousarray(poses), sensing_range, out)
    return out.reshape(records * robots, robots - 1, 3)
