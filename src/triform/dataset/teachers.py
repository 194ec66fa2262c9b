"""Teachers: who drives the roll-outs and labels every record.

A teacher is a function of the poses alone. It runs on one thread and lets go of the interpreter's lock, because
shards are collected side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numba import njit

from triform.control import expert_into
from triform.types import FloatArray

#: Poses (B, N, 3) in the world frame to body twists (B, N, 3).
Teacher = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class TeacherSettings:
    """What a teacher is made of.

    Attributes:
        distance: Prescribed neighbour distance d* [m].
        gain: Spring gain [1/s].
        max_speed: Longer commands are scaled to this speed [m/s].
        sensing_range: Range of the robots' scans [m].
    """

    distance: float
    gain: float
    max_speed: float
    sensing_range: float


@njit(cache=True, nogil=True)
def _expert_serial(poses, distance, gain, max_speed, sensing_range, out):  # type: ignore[no-untyped-def]
    robots = poses.shape[1]
    active = np.ones(robots, dtype=np.bool_)
    graph = np.empty((robots, robots), dtype=np.bool_)
    for b in range(poses.shape[0]):
        expert_into(poses[b], active, distance, gain, max_speed, sensing_range, graph, out[b])


def _expert(settings: TeacherSettings, sensing_range: float) -> Teacher:
    def command(poses: FloatArray) -> FloatArray:
        out = np.empty_like(poses)
        _expert_serial(poses, settings.distance, settings.gain, settings.max_speed, sensing_range, out)
        return out

    return command


def expert(settings: TeacherSettings) -> Teacher:
    """The expert of Eq. 7-9, who sees every robot."""
    return _expert(settings, np.inf)


def expert_sensed(settings: TeacherSettings) -> Teacher:
    """The expert of Eq. 7-9 restricted to the robots within the range of the scans."""
    return _expert(settings, settings.sensing_range)


#: Makers of teachers by name.
TEACHERS: Mapping[str, Callable[[TeacherSettings], Teacher]] = MappingProxyType(
    {"expert": expert, "expert-sensed": expert_sensed}
)
