"""What simulators of physics see, for the built-in LiDAR."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from triform.simulation import Arena
from triform.simulators.chassis import WALL_THICKNESS
from triform.types import FloatArray


def scattered(rng: np.random.Generator, robots: int) -> FloatArray:
    """Random poses in the middle of the arena at least half a metre apart."""
    while True:
        poses = np.column_stack([rng.uniform(-2.5, 2.5, (robots, 2)), rng.uniform(-np.pi, np.pi, robots)])
        apart = np.hypot(*(poses[:, None, :2] - poses[None, :, :2]).transpose(2, 0, 1))
        if (apart + np.eye(robots)).min() > 0.5:
            return poses


def with_thick_walls(arena: Arena) -> Arena:
    """The arena as simulators have it: every wall is a box."""
    ends = arena.walls.reshape(-1, 2, 2)
    along = ends[:, 1] - ends[:, 0]
    across = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    left, right = (ends + side * WALL_THICKNESS / 2 * across[:, None] for side in (1, -1))
    corners = [left[:, 0], left[:, 1], right[:, 1], right[:, 0]]
    sides = [np.hstack(pair) for pair in zip(corners, corners[1:] + corners[:1], strict=True)]
    return replace(arena, walls=np.vstack(sides))
