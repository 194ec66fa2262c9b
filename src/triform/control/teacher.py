"""Teachers: experts that label states for imitation learning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from triform.control.expert import ExpertVariant, expert_into, expert_variant
from triform.types import FloatArray, require


@njit(cache=True, nogil=True)
def _label(poses, distance, gain, odd_gain, max_speed, sensing_range, out):  # type: ignore[no-untyped-def]
    robots = poses.shape[1]
    active = np.ones(robots, dtype=np.bool_)
    graph = np.empty((robots, robots), dtype=np.bool_)
    for b in range(poses.shape[0]):
        expert_into(poses[b], active, distance, gain, odd_gain, max_speed, sensing_range, graph, out[b])


@dataclass(frozen=True)
class Teacher:
    """An expert as a teacher.

    Attributes:
        name: One of ``EXPERTS``.
        distance: Prescribed neighbour distance d* [m].
        gain: Spring gain [1/s].
        max_speed: Longer commands are scaled to this speed [m/s].
    """

    name: str
    distance: float = 1.0
    gain: float = 1.0
    max_speed: float = 1.0

    def __post_init__(self) -> None:
        expert_variant(self.name)
        for name in ("distance", "gain", "max_speed"):
            value = getattr(self, name)
            require(0 < value < np.inf, f"teacher {name} is {value}; it must be positive and finite")

    @property
    def variant(self) -> ExpertVariant:
        """Sight and odd gain of the expert."""
        return expert_variant(self.name)

    def label(self, poses: FloatArray) -> FloatArray:
        """Body twists (B, N, 3) for poses (B, N, 3); on one thread, with the interpreter's lock released."""
        given = np.ascontiguousarray(poses, dtype=np.float64)
        out = np.empty_like(given)
        variant = self.variant
        _label(given, self.distance, self.gain, variant.odd_gain, self.max_speed, variant.sensing_range, out)
        return out
