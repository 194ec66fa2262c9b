"""Formations that tests measure: a hexagon, and teams that stand still."""

from __future__ import annotations

import numpy as np

from triform.evaluation import Trajectory

PERIOD = 0.1


def hexagon(distance=1.0):
    """Seven robots: a centre and its six neighbours."""
    angle = np.arange(6) * np.pi / 3
    ring = distance * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([np.zeros((1, 2)), ring])


def still(positions, duration=8.0, active=None):
    """B teams that stay where they are; ``positions`` (B, N, 2)."""
    positions = np.asarray(positions, dtype=float)
    steps = round(duration / PERIOD)
    runs, robots = positions.shape[:2]
    present = np.ones((runs, robots), dtype=bool) if active is None else np.asarray(active)
    poses = np.concatenate([positions, np.zeros((runs, robots, 1))], axis=-1)
    poses[~present] = np.nan
    return Trajectory(
        PERIOD * np.arange(steps + 1),
        np.repeat(poses[:, None], steps + 1, axis=1),
        np.repeat(present[:, None], steps + 1, axis=1),
        np.zeros((runs, steps, robots, 3)),
    )
