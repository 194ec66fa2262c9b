"""Teachers: experts that label states for imitation learning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from triform.control.expert import ExpertVariant, Springs, expert_variant, expert_worlds
from triform.types import FloatArray, convert_fields, require


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
        convert_fields(self)
        expert_variant(self.name)
        for name in ("distance", "gain", "max_speed"):
            value = getattr(self, name)
            require(0 < value < np.inf, f"teacher {name} is {value}; it must be positive and finite")

    @property
    def variant(self) -> ExpertVariant:
        """Sight and odd gain of the expert."""
        return expert_variant(self.name)

    @property
    def springs(self) -> Springs:
        """The expert as kernels take it."""
        variant = self.variant
        return Springs(self.distance, self.gain, variant.odd_gain, self.max_speed, variant.sensing_range)

    def label(self, poses: FloatArray) -> FloatArray:
        """Body twists (B, N, 3) for poses (B, N, 3); on one thread, with the interpreter's lock released."""
        given = np.ascontiguousarray(poses, dtype=np.float64)
        out = np.empty_like(given)
        expert_worlds(given, np.ones(given.shape[:2], dtype=np.bool_), self.springs, out, 0, len(given))
        return out
