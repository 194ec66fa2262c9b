"""Where the other robots of a record are, seen from each: the truth behind a map."""

from __future__ import annotations

import numpy as np

from triform.control import Teacher
from triform.geometry import gabriel_into
from triform.kernels import kernel
from triform.types import FloatArray

#: Columns: x, y [m], the robot's term of the expert's sum for unit gain (2) [m], whether it is a Gabriel neighbour and
#: whether it shares one with the robot that looks.
COLUMNS = 6


@kernel
def neighbours_into(poses, graph, distance, odd_gain, out):
    """Write the other robots of one record in each robot's body frame.

    Args:
        poses: Poses [m, m, rad], shape (N, 3).
        graph: Which pairs are neighbours, bool, shape (N, N).
        distance: Prescribed neighbour distance d* [m].
        odd_gain: Gain of the expert's odd spring over that of its spring.
        out: The others, in order, shape (N, N - 1, COLUMNS).
    """
    robots = poses.shape[0]
    for i in range(robots):
        cos, sin = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        slot = 0
        for j in range(robots):
            if j == i:
                continue
            d_x, d_y = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
            x, y = cos * d_x + sin * d_y, -sin * d_x + cos * d_y
            length = np.sqrt(x * x + y * y) + 1e-9
            strain = (length - distance) / length if graph[i, j] else 0.0
            shared = 0.0
            for k in range(robots):
                if graph[i, k] and graph[j, k]:
                    shared = 1.0
            out[i, slot, 0], out[i, slot, 1] = x, y
            out[i, slot, 2], out[i, slot, 3] = strain * (x - odd_gain * y), strain * (y + odd_gain * x)
            out[i, slot, 4] = 1.0 if graph[i, j] else 0.0
            out[i, slot, 5] = shared
            slot += 1


@kernel
def _neighbours(poses, sensing_range, distance, odd_gain, out):
    robots = poses.shape[1]
    active = np.ones(robots, dtype=np.bool_)
    graph = np.empty((robots, robots), dtype=np.bool_)
    for e in range(poses.shape[0]):
        gabriel_into(poses[e], active, sensing_range, graph)
        neighbours_into(poses[e], graph, distance, odd_gain, out[e])


def neighbours(poses: FloatArray, teacher: Teacher) -> FloatArray:
    """The other robots in the body frame of each.

    Args:
        poses: Poses of E records [m, m, rad], shape (E, N, 3).
        teacher: Whose neighbours and terms are meant.

    Returns:
        What ``COLUMNS`` says of every other robot, shape (E * N, N - 1, COLUMNS).
    """
    records, robots = poses.shape[:2]
    out = np.empty((records, robots, robots - 1, COLUMNS))
    variant = teacher.variant
    _neighbours(np.ascontiguousarray(poses), variant.sensing_range, teacher.distance, variant.odd_gain, out)
    return out.reshape(records * robots, robots - 1, COLUMNS)
