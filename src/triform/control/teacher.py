"""Teachers: experts that label states for imitation learning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from triform.types import ConfigurationError, require


@dataclass(frozen=True)
class Teacher:
    """The expert of Eq. 7-9 as a teacher.

    Attributes:
        name: Its name, ``expert`` or ``expert-sensed``.
        sensing_range: Robots farther away do not enter its command [m].
        distance: Prescribed neighbour distance d* [m].
        gain: Spring gain [1/s].
        max_speed: Longer commands are scaled to this speed [m/s].
    """

    name: str
    sensing_range: float
    distance: float = 1.0
    gain: float = 1.0
    max_speed: float = 1.0

    def __post_init__(self) -> None:
        for name in ("sensing_range", "distance", "gain", "max_speed"):
            value = getattr(self, name)
            require(value > 0, f"teacher {name} is {value}; it must be positive")


TEACHERS = {
    "expert": Teacher("expert", np.inf),
    "expert-sensed": Teacher("expert-sensed", 2.0),
}


def get_teacher(name: str) -> Teacher:
    """Return a teacher by name.

    Raises:
        ConfigurationError: If there is none of that name.
    """
    if name not in TEACHERS:
        raise ConfigurationError(f"there is no teacher {name!r}; there are {', '.join(sorted(TEACHERS))}")
    return TEACHERS[name]
