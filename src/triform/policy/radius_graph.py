"""Who hears whom in teams that talk: what a graph network reads, without PyTorch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triform.geometry.cells import pairs_within
from triform.kernels import kernel
from triform.types import FloatArray, IntArray, require

#: Numbers that a receiver knows of an edge: see ``RadiusGraph``.
EDGE_FEATURES = 6
#: Sums over what a robot hears are multiplied by this, about one over the usual number of robots in reach.
SUM_SCALE = 0.125


@dataclass(frozen=True)
class RadiusGraph:
    """Directed edges between robots that hear each other, in one or more teams; all lengths in d*.

    Attributes:
        features: What the receiver knows of every edge: where the sender is in the receiver's body frame (x, y), how
            far away, cosine and sine of the sender's heading in that frame, and the radius of the disc for which
            every robot of the team blocks sight, float32, shape (E, EDGE_FEATURES).
        receivers: Robot that hears, shape (E,), growing.
        senders: Robot that is heard, shape (E,), growing for each receiver.
        robots: Number of robots M.
    """

    features: NDArray[np.float32]
    receivers: IntArray
    senders: IntArray
    robots: int


@kernel
def _hear(poses, offsets, blocking, reach):
    """Edges within teams that begin at ``offsets``; see ``hear``. Returns features, receivers and senders."""
    edges = 0
    found = []
    for e in range(offsets.shape[0] - 1):
        first, last = offsets[e], offsets[e + 1]
        pairs = pairs_within(poses[first:last], np.ones(last - first, dtype=np.bool_), reach * reach)
        # Both directions of every pair, in growing order of receiver and then sender.
        keys = np.empty(2 * pairs.shape[0], dtype=np.int64)
        for p in range(pairs.shape[0]):
            keys[2 * p] = pairs[p, 0] * (last - first) + pairs[p, 1]
            keys[2 * p + 1] = pairs[p, 1] * (last - first) + pairs[p, 0]
        keys.sort()
        found.append(keys)
        edges += keys.shape[0]
    features = np.empty((edges, EDGE_FEATURES), dtype=np.float32)
    receivers, senders = np.empty(edges, dtype=np.int64), np.empty(edges, dtype=np.int64)
    edge = 0
    for e in range(offsets.shape[0] - 1):
        first, robots = offsets[e], offsets[e + 1] - offsets[e]
        for key in found[e]:
            i, j = first + key // robots, first + key % robots
            d_x, d_y = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
            cos, sin = np.cos(poses[i, 2]), np.sin(poses[i, 2])
            features[edge, 0], features[edge, 1] = cos * d_x + sin * d_y, cos * d_y - sin * d_x
            features[edge, 2] = np.sqrt(d_x * d_x + d_y * d_y)
            turn = poses[j, 2] - poses[i, 2]
            features[edge, 3], features[edge, 4] = np.cos(turn), np.sin(turn)
            features[edge, 5] = blocking[e]
            receivers[edge], senders[edge] = i, j
            edge += 1
    return features, receivers, senders


def hear(poses: FloatArray, offsets: IntArray, blocking: FloatArray, reach: float) -> RadiusGraph:
    """Who hears whom in teams.

    Args:
        poses: Poses of all robots, team behind team [d*, d*, rad], shape (M, 3).
        offsets: Where every team begins, and the end of the last one, shape (T + 1,).
        blocking: Radius of the disc for which a robot of each team blocks sight [d*], shape (T,).
        reach: Robots within this distance hear each other [d*].

    Raises:
        ConfigurationError: If the shapes do not fit.
    """
    require(
        poses.ndim == 2 and poses.shape[1] == 3 and offsets.ndim == 1 and len(offsets) == len(blocking) + 1
        and offsets[0] == 0 and offsets[-1] == len(poses) and bool((np.diff(offsets) >= 0).all()),
        f"poses of shape {poses.shape} given; (M, 3) is needed, and teams that begin at growing offsets from 0 to M",
    )  # fmt: skip
    # An empty list has no type for the compiler.
    if len(blocking) == 0:
        nobody = np.empty(0, dtype=np.int64)
        return RadiusGraph(np.empty((0, EDGE_FEATURES), dtype=np.float32), nobody, nobody, 0)
    features, receivers, senders = _hear(
        np.ascontiguousarray(poses, dtype=np.float64), offsets.astype(np.int64),
        np.ascontiguousarray(blocking, dtype=np.float64), reach,
    )  # fmt: skip
    return RadiusGraph(features, receivers, senders, len(poses))
