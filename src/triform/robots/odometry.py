"""What wheel odometry said, asked for at any moment."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np

from triform.geometry import wrap_angle
from triform.types import FloatArray

#: How far past the newest numbers a track is followed [s].
EXTRAPOLATION = 0.2

#: Moments that are remembered: five seconds at 20 Hz.
_REMEMBERED = 100
#: Speeds are taken over at least this time [s]: messages that were held up come in bunches.
_RATE_TIME = 0.1


class Track:
    """Numbers that change with time, known at some moments."""

    def __init__(self) -> None:
        """Begin with nothing known."""
        self._times: deque[float] = deque(maxlen=_REMEMBERED)
        self._values: deque[FloatArray] = deque(maxlen=_REMEMBERED)

    @property
    def newest(self) -> FloatArray | None:
        """The newest numbers."""
        return self._values[-1] if self._values else None

    def add(self, moment: float, values: FloatArray) -> None:
        """Remember numbers of a moment [s], in place of others of the same one; an earlier moment starts anew."""
        if self._times and moment < self._times[-1]:
            self._times.clear()
            self._values.clear()
        elif self._times and moment == self._times[-1]:
            self._times.pop()
            self._values.pop()
        self._times.append(moment)
        self._values.append(values)

    def add_angle(self, moment: float, values: FloatArray) -> None:
        """As ``add``, for numbers of which the last is an angle [rad]; it goes on past half a turn."""
        if self.newest is not None:
            values = np.append(values[:-1], self.newest[-1] + wrap_angle(values[-1] - self.newest[-1]))
        self.add(moment, values)

    def at(self, moment: float) -> FloatArray | None:
        """Numbers at a moment [s]: between known ones, or ahead of the newest one at the last speed."""
        if not self._times or not self._times[0] <= moment <= self._times[-1] + EXTRAPOLATION:
            return None
        times, values = np.array(self._times), np.array(self._values)
        earlier = np.flatnonzero(times <= times[-1] - _RATE_TIME)
        if moment > times[-1] and earlier.size:
            first = earlier[-1]
            rate = (values[-1] - values[first]) / (times[-1] - times[first])
            return np.asarray(values[-1] + rate * (moment - times[-1]))
        return np.array([np.interp(moment, times, column) for column in values.T])


class PoseHistory:
    """The poses of the last seconds; any thread may add and ask."""

    def __init__(self) -> None:
        """Begin with no pose."""
        self._lock = threading.Lock()
        self._track = Track()

    def add(self, moment: float, pose: FloatArray) -> None:
        """Take note of a pose, shape (3,) [m, m, rad], at a moment [s]; an earlier one than the newest starts anew."""
        with self._lock:
            self._track.add_angle(moment, pose)

    def at(self, moment: float) -> FloatArray | None:
        """Pose at a moment [s], shape (3,), heading in [-pi, pi); ``None`` if it is not known."""
        with self._lock:
            pose = self._track.at(moment)
        return None if pose is None else np.append(pose[:2], wrap_angle(pose[2]))
