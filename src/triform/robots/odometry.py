"""What wheel odometry said, asked for at any moment."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np

from triform.types import FloatArray

#: Poses are kept for this long [s].
_KEPT = 3.0
#: The newest pose speaks for this long after it [s].
_AHEAD = 0.2


class PoseHistory:
    """The poses of the last seconds, interpolated; any thread may add and ask."""

    def __init__(self) -> None:
        """Begin with no pose."""
        self._lock = threading.Lock()
        self._poses: deque[tuple[float, FloatArray]] = deque()

    def add(self, time: float, pose: FloatArray) -> None:
        """Take note of a pose, shape (3,), at a time [s]; one that is older than the newest starts anew."""
        with self._lock:
            if self._poses and time <= self._poses[-1][0]:
                self._poses.clear()
            self._poses.append((time, pose))
            while self._poses[0][0] < time - _KEPT:
                self._poses.popleft()

    def at(self, time: float) -> FloatArray | None:
        """Return the pose at a time [s], shape (3,), heading in [-pi, pi).

        Between two poses it is interpolated, and for 0.2 s beyond the newest one the motion between the last two goes
        on; at other times it is not known (``None``).
        """
        with self._lock:
            poses = list(self._poses)
        times = [when for when, _ in poses]
        if len(poses) < 2 or not times[0] <= time <= times[-1] + _AHEAD:
            return None
        after = min(max(1, int(np.searchsorted(times, time))), len(poses) - 1)
        (begin, start), (end, goal) = poses[after - 1], poses[after]
        way = goal - start
        way[2] = (way[2] + np.pi) % (2 * np.pi) - np.pi
        pose = start + way * ((time - begin) / (end - begin))
        pose[2] = (pose[2] + np.pi) % (2 * np.pi) - np.pi
        return pose
