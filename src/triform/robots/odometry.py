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
    """Numbers that change with time, known at the moments of the last seconds; any thread may add and ask."""

    def __init__(self, angle: bool = False) -> None:
        """Begin with nothing known.

        Args:
            angle: Whether the last number is an angle [rad], which goes on past half a turn.
        """
        self._angle = angle
        self._lock = threading.Lock()
        self._times: deque[float] = deque(maxlen=_REMEMBERED)
        self._values: deque[FloatArray] = deque(maxlen=_REMEMBERED)

    def add(self, moment: float, values: FloatArray) -> None:
        """Remember numbers of a moment [s], in place of others of the same one; an earlier moment starts anew."""
        with self._lock:
            if self._angle and self._values:
                before = self._values[-1][-1]
                values = np.append(values[:-1], before + wrap_angle(values[-1] - before))
            if self._times and moment < self._times[-1]:
                self._times.clear()
                self._values.clear()
            elif self._times and moment == self._times[-1]:
                self._times.pop()
                self._values.pop()
            self._times.append(moment)
            self._values.append(values)

    def at(self, moment: float) -> FloatArray | None:
        """Numbers at a moment [s]: between known ones, or ahead of the newest one at the last speed.

        Returns:
            The numbers, an angle in [-pi, pi); ``None`` if they are not known.
        """
        with self._lock:
            if not self._times or not self._times[0] <= moment <= self._times[-1] + EXTRAPOLATION:
                return None
            times, values = np.array(self._times), np.array(self._values)
        earlier = np.flatnonzero(times <= times[-1] - _RATE_TIME)
        if moment > times[-1] and earlier.size:
            first = earlier[-1]
            rate = (values[-1] - values[first]) / (times[-1] - times[first])
            found = values[-1] + rate * (moment - times[-1])
        else:
            found = np.array([np.interp(moment, times, column) for column in values.T])
        return np.append(found[:-1], wrap_angle(found[-1])) if self._angle else found
