"""Acceleration limits for commands that nothing may lengthen or turn."""

from __future__ import annotations

import math

import numpy as np

from triform.simulation import Drive
from triform.types import FloatArray


def limit_acceleration(wanted: FloatArray, previous: FloatArray, drive: Drive, duration: float) -> FloatArray:
    """Return the command that comes nearest to ``wanted`` within what the drive can do in one control period.

    The result lies between zero and ``wanted``, in translation and in turn rate. So whatever a guard allowed stays
    allowed, for it always allows less of the same; and so braking is never delayed: where the limits would ask for a
    command beyond that, the one nearest to ``previous`` is taken.

    Args:
        wanted: Body twist that is asked for, shape (3,) [m/s, m/s, rad/s].
        previous: Body twist of the period before, shape (3,) [m/s, m/s, rad/s].
        drive: ``max_acceleration`` and ``max_turn_acceleration`` hold; the other limits are not used.
        duration: Length of a control period [s].
    """
    return np.array(
        [
            *_towards(wanted[:2], previous[:2], drive.max_acceleration * duration),
            *_towards(wanted[2:], previous[2:], drive.max_turn_acceleration * duration),
        ]
    )


def _towards(wanted: FloatArray, previous: FloatArray, reach: float) -> FloatArray:
    """Longest part of ``wanted`` no farther than ``reach`` from ``previous``, or else the part nearest to it."""
    length = float(np.linalg.norm(wanted))
    if length == 0.0 or math.isinf(reach):
        return wanted
    along = float(wanted @ previous) / length
    aside = float(previous @ previous) - along**2
    share = (along + math.sqrt(max(0.0, reach**2 - aside))) / length
    return wanted * min(max(share, 0.0), 1.0)
