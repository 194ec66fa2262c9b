"""What the built-in world and other simulators have in common."""

from __future__ import annotations

from typing import Protocol

from numpy.typing import ArrayLike

from triform.simulation.arena import Arena
from triform.simulation.profiles import Profile
from triform.types import BoolArray, FloatArray, PrivilegedView, Team


class SimulatedTeam(Team[PrivilegedView], Protocol):
    """B simulated worlds of robots that come and go, whose true poses and contacts are known; see ``World``."""

    @property
    def newcomer(self) -> Profile:
        """Kind of a robot that joins."""
        ...

    @property
    def arena(self) -> Arena:
        """Walls and pillars."""
        ...

    @property
    def poses(self) -> FloatArray:
        """True poses in the world frame, shape (B, N, 3) [m, m, rad]; ``NaN`` where not active."""
        ...

    @property
    def active(self) -> BoolArray:
        """Which robots exist, shape (B, N)."""
        ...

    @property
    def min_distance(self) -> FloatArray:
        """Smallest distance between two centres so far, shape (B,) [m]."""
        ...

    @property
    def collided(self) -> BoolArray:
        """Whether two robots have overlapped, or touched where bodies are solid, shape (B,)."""
        ...

    @property
    def hit_arena(self) -> BoolArray:
        """Whether a robot has overlapped or touched a wall or pillar, shape (B,)."""
        ...

    def add_robot(self, world: int, pose: ArrayLike) -> int:
        """Add a robot at rest at ``pose``, shape (3,), to one world and return its index along axis N."""
        ...

    def remove_robot(self, world: int, robot: int) -> None:
        """Take a robot out of one world."""
        ...
