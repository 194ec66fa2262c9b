"""Where simulated robots are, as their odometry tells it."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from tests.ros2.conftest import Ros
from triform.evaluation.metrics import TOLERANCE, WINDOW
from triform.geometry import assess, edge_error


def note(track: list[list[float]], message: Any) -> None:
    """Append a pose (x, y, heading)."""
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    track.append([place.x, place.y, 2 * np.arctan2(turn.z, turn.w)])


class Observer:
    """Notes where all robots are."""

    def __init__(self, ros: Ros, names: list[str], rate: float) -> None:
        from nav_msgs.msg import Odometry

        self._ros, self._span = ros, int(WINDOW * rate)
        self.tracks: list[list[list[float]]] = [[] for _ in names]
        for name, track in zip(names, self.tracks, strict=True):
            ros.node.create_subscription(Odometry, f"{name}/odom", partial(note, track), 50)

    def error(self) -> float:
        """Mean relative edge error of the last 5 s."""
        if min(map(len, self.tracks)) < self._span:
            return np.inf
        positions = np.array([track[-self._span :] for track in self.tracks])[..., :2].swapaxes(0, 1)[None]
        active = np.ones((1, self._span, len(self.tracks)), dtype=bool)
        return float(edge_error(positions, 1.0, np.inf, active).mean())

    def is_triangulation(self) -> bool:
        """Whether the robots now stand in a triangulation, each edge within 10 % of 1 m."""
        positions = np.array([track[-1][:2] for track in self.tracks])
        return bool(assess(positions, 1.0).strict)

    def wait_for_formation(self, what: str) -> float:
        """Wait for 5 s with an error below 10 %, all of them later than now."""
        for track in self.tracks:
            track.clear()
        self._ros.until(lambda: self.error() < TOLERANCE, what, patience=90.0)
        return self.error()
