"""Teachers: experts that label states for imitation learning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from triform.control.expert import SENSING_RANGE, expert_into
from triform.types import ConfigurationError, FloatArray, require

#: Teachers by name, with the range of sight of each [m].
TEACHERS = {"expert": np.inf, "expert-sensed": SENSING_RANGE}


@njit(cache=True, nogil=True)
def _label(poses, distance, gain, max_speed, sensing_range, out):  # type: ignore[no-untyped-def]
    robots = poses.shape[1]
    active = np.ones(robots, dtype=np.bool_)
    graph = np.empty((robots, robots), dtype=np.bool_)
    for b in range(poses.shape[0]):
        expert_into(poses[b], active, distance, gain, max_speed, sensing_range, graph, out[b])


@dataclass(frozen=True)
class Teacher:
    """The expert of Eq. 7-9 as a teacher.

    Attributes:
        name: One of ``TEACHERS``: ``expert`` sees every robot, ``expert-sensed`` those that a scan can reach.
        distance: Prescribed neighbour distance d* [m].
        gain: Spring gain [1/s].
        max_speed: Longer commands are scaled to this speed [m/s].
    """

    name: str
    distance: float = 1.0
    gain: float = 1.0
    max_speed: float = 1.0

    def __post_init__(self) -> None:
        if self.name not in TEACHERS:
            raise ConfigurationError(f"there is no teacher {self.name!r}; the teachers are {', '.join(TEACHERS)}")
        for name in ("distance", "gain", "max_speed"):
            value = getattr(self, name)
            require(0 < value < np.inf, f"teacher {name} is {value}; it must be positive and finite")

    @property
    def sensing_range(self) -> float:
        """Robots farther away do not enter its command [m]."""
        return TEACHERS[self.name]

    def label(self, poses: FloatArray) -> FloatArray:
        """Body twists (B, N, 3) for poses (B, N, 3); on one thread, with the interpreter's lock released."""
        out = np.empty_like(poses)
        _label(poses, self.distance, self.gain, self.max_speed, self.sensing_range, out)
        return out
