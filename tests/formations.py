"""Formations that tests measure: a hexagon, teams that stand still, and robots that hang by a bridge."""

from __future__ import annotations

import numpy as np
from shapely.geometry import LineString, Point

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


def hangs_by_its_words(points, linked, sight, j):
    """Whether point j hangs from a neighbour of point 0, as the docstring of ``hangs`` says.

    Points (K, 2) are relative to point 0, in units of d*; ``linked`` is their Gabriel graph.
    """

    def surely_seen(place):
        line = LineString([(0, 0), place])
        # A robot beside the line's ends stands before neither of them.
        before = [0 < place @ point < place @ place for point in points[1:]]
        near = [line.distance(Point(point)) < 0.2 for point in points[1:]]
        return np.linalg.norm(place) <= sight - 0.2 and not (np.array(before) & near).any()

    for k in np.flatnonzero(linked[0] & linked[j]):
        edge = points[j] - points[k]
        height = np.sqrt(3) / 2 * np.array([-edge[1], edge[0]])
        corners = [(points[j] + points[k]) / 2 + side * height for side in (-1, 1)]
        alone = not (linked[j] & linked[k]).any()
        if alone and np.linalg.norm(edge) <= 1.4 and all(surely_seen(corner) for corner in corners):
            return True
    return False
