"""What wheel odometry said, asked for at any moment."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence

import numpy as np

from triform.geometry import wrap_angle
from triform.types import FloatArray

#: How far past the newest numbers a track is followed [s].
EXTRAPOLATION = 0.2

#: Moments that are remembered: five seconds at 20 Hz.
_REMEMBERED = 100
#: Speeds are taken over at least this time [s]: messages that were held up come in bunches.
_RATE_TIME = 0.1
#: Numbers that change faster than this many times what they can are none of this robot's, or of another zero.
_IMPLAUSIBLE = 2.0
#: A message may have been held up for so long [s].
_HELD_UP = 0.2
#: Larger numbers are no robot's [m, rad].
_LARGEST = 1e5


def is_place(numbers: FloatArray) -> bool:
    """Tell whether a robot can be where odometry says, numbers of any shape [m, rad]."""
    return bool((np.abs(numbers) <= _LARGEST).all())


def is_motion(change: FloatArray, passed: float, fastest: FloatArray) -> bool:
    """Tell whether a robot can have moved as odometry says.

    Args:
        change: How numbers such as a pose have changed, shape (K,) [m, rad].
        passed: Time in between [s].
        fastest: How fast each number can change, shape (K,) [1/s]; infinite if that is not known.
    """
    return bool((np.abs(change) <= _IMPLAUSIBLE * fastest * (max(passed, 0.0) + _HELD_UP)).all())


class Track:
    """Numbers that change with time, known at the moments of the last seconds; any thread may add and ask.

    Numbers that are not finite or too large for a robot are passed over. After a leap that no robot can make nothing is
    known, until the next numbers agree with those after the leap.
    """

    def __init__(self, fastest: Sequence[float], angle: bool = False) -> None:
        """Begin with nothing known.

        Args:
            fastest: How fast each number can change [1/s]; infinite if that is not known.
            angle: Whether the last number is an angle [rad], which goes on past half a turn.
        """
        self._fastest, self._angle = np.array(fastest), angle
        self._leapt = False
        self._lock = threading.Lock()
        self._times: deque[float] = deque(maxlen=_REMEMBERED)
        self._values: deque[FloatArray] = deque(maxlen=_REMEMBERED)

    def add(self, moment: float, values: FloatArray) -> None:
        """Remember numbers of a moment [s], in place of others of the same one; an earlier moment starts anew."""
        if not is_place(values):
            return
        with self._lock:
            if self._angle and self._values:
                before = self._values[-1][-1]
                values = np.append(values[:-1], before + wrap_angle(values[-1] - before))
            if self._times:
                passed = moment - self._times[-1]
                self._leapt = not is_motion(values - self._values[-1], passed, self._fastest)
                if passed < 0 or self._leapt:
                    self._times.clear()
                    self._values.clear()
                elif passed == 0:
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
            if self._leapt or not self._times or not self._times[0] <= moment <= self._times[-1] + EXTRAPOLATION:
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
