"""The model-based expert, Eq. 7-9: springs along the edges of the Gabriel graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from triform.control.loop import true_poses
from triform.geometry import gabriel_into
from triform.geometry.cells import SMALL_TEAM, list_cells, make_cells
from triform.geometry.gabriel import ROBOTS_PER_THREAD
from triform.geometry.gabriel_kernels import list_neighbours, make_workspace
from triform.kernels import kernel
from triform.threads import in_parts, usable_threads
from triform.types import SENSING_RANGE, BoolArray, FloatArray, PrivilegedView, choose, require

#: A RoboMaster EP whose centre is this far away still shows its near side to a LiDAR of 2 m [m].
VISIBLE_RANGE = 2.12


@dataclass(frozen=True)
class ExpertVariant:
    """What distinguishes one expert from another.

    Attributes:
        sensing_range: Farther robots are not seen [m].
        odd_gain: Gain of the odd spring [1/s]; 0 is Eq. 8.
    """

    sensing_range: float
    odd_gain: float


#: Experts by name. ``expert-odd`` is not the paper's: see ``Expert``.
EXPERTS = {
    "expert": ExpertVariant(np.inf, 0.0),
    "expert-sensed": ExpertVariant(SENSING_RANGE, 0.0),
    "expert-odd": ExpertVariant(VISIBLE_RANGE, 0.8),
}


def expert_variant(name: str) -> ExpertVariant:
    """Return an expert's settings by name.

    Raises:
        ConfigurationError: If there is none of that name.
    """
    return choose("expert", name, EXPERTS)


class Springs(NamedTuple):
    """What an expert does about its neighbours.

    Attributes:
        distance: Prescribed neighbour distance d* [m].
        gain: Spring gain [1/s].
        odd_gain: Gain of the odd spring [1/s].
        max_speed: Speed to which a longer command is scaled [m/s].
        sensing_range: Farther robots are not seen [m].
    """

    distance: float
    gain: float
    odd_gain: float
    max_speed: float
    sensing_range: float


@kernel
def _pull(poses, i, j, springs):
    """What the edge to robot j adds to the velocity of robot i in the world frame [m/s]."""
    d_x = poses[j, 0] - poses[i, 0]
    d_y = poses[j, 1] - poses[i, 1]
    length = np.sqrt(d_x * d_x + d_y * d_y)
    if length == 0.0:
        return 0.0, 0.0
    gain, odd_gain = springs.gain, springs.odd_gain
    strain = (length - springs.distance) / length
    return strain * (gain * d_x - odd_gain * d_y), strain * (gain * d_y + odd_gain * d_x)


@kernel
def _write_twist(poses, i, v_x, v_y, max_speed, out):
    """Write the body twist of robot i, ``out[i]``, for a velocity in the world frame."""
    speed = np.sqrt(v_x * v_x + v_y * v_y)
    if speed > max_speed:
        v_x *= max_speed / speed
        v_y *= max_speed / speed
    cos, sin = np.cos(poses[i, 2]), np.sin(poses[i, 2])
    out[i, 0] = cos * v_x + sin * v_y
    out[i, 1] = -sin * v_x + cos * v_y
    out[i, 2] = 0.0


@kernel
def expert_into(poses, active, springs, graph, out):
    """Write the expert's body twists of one small team; allocates nothing for up to ``SMALL_TEAM`` robots.

    Args:
        poses: Poses in the world frame [m, m, rad], shape (N, 3).
        active: Robots that exist, shape (N,); the twists of others are zero.
        springs: ``Springs``.
        graph: Gabriel graph to fill, bool, shape (N, N).
        out: Body twists to fill [m/s, m/s, rad/s], shape (N, 3).
    """
    gabriel_into(poses, active, springs.sensing_range, graph)
    for i in range(active.shape[0]):
        if not active[i]:
            out[i] = 0.0
        else:
            v_x = v_y = 0.0
            for j in range(active.shape[0]):
                if graph[i, j]:
                    pull_x, pull_y = _pull(poses, i, j, springs)
                    v_x += pull_x
                    v_y += pull_y
            _write_twist(poses, i, v_x, v_y, springs.max_speed, out)


@kernel
def _expert_cells(world, cells, poses, springs, out):
    """Write the body twists of the robots in some ``cells`` of a world."""
    robots, _, parts, _ = world
    limit = springs.sensing_range * springs.sensing_range
    workspace, ends = make_workspace(robots.shape[0]), np.empty(robots.shape[0] + 1, dtype=np.int64)
    listed = np.empty((64, 1), dtype=np.int64)
    for cell in cells:
        listed = list_neighbours(world, cell, limit, workspace, listed, ends)
        for own in range(parts[cell, 0], parts[cell, 1]):
            i, k = robots[own], own - parts[cell, 0]
            v_x = v_y = 0.0
            # In growing order of the robots, as in ``expert_into``, so that both round alike.
            for neighbour in range(ends[k], ends[k + 1]):
                pull_x, pull_y = _pull(poses, i, listed[neighbour, 0], springs)
                v_x += pull_x
                v_y += pull_y
            _write_twist(poses, i, v_x, v_y, springs.max_speed, out)


@kernel
def expert_worlds(poses, active, springs, out, first, last):
    """Write the expert's body twists of the worlds ``first <= b < last``; arguments as ``expert_into``, (B, ...)."""
    robots = poses.shape[1]
    small = robots <= SMALL_TEAM
    graph = np.empty((robots, robots) if small else (0, 0), dtype=np.bool_)
    for b in range(first, last):
        if small:
            expert_into(poses[b], active[b], springs, graph, out[b])
        else:
            out[b] = 0.0
            world = make_cells(poses[b], active[b])
            cells = list_cells(world)
            _expert_cells(world, cells, poses[b], springs, out[b])


class Expert:
    """Expert of Eq. 7-9, a ``Controller[PrivilegedView]``.

    Robot i moves down the gradient of ``gain/2 * sum_j (|p_i - p_j| - d*)^2`` over its Gabriel neighbours j. Eq. 8
    as printed has the opposite sign of ``(p_i - p_j)``, which would push far neighbours away; here they attract.
    Coincident robots exert no force on each other: no direction is defined. The turn rate is always zero.

    With an ``odd_gain`` every edge also pushes sideways, ``odd_gain (|p_i - p_j| - d*)`` at +90 degrees to it (odd
    elasticity). The sum turns each command by ``atan(odd_gain / gain)`` and lengthens it, so a team rests exactly where
    it rested before; but it gets there in a swirl, and on the way ends in a better formation more often.
    """

    privileged = True

    def __init__(
        self,
        distance: float = 1.0,
        gain: float = 1.0,
        max_speed: float = 1.0,
        sensing_range: float = np.inf,
        odd_gain: float = 0.0,
    ) -> None:
        """Make an expert.

        Args:
            distance: Prescribed neighbour distance d* [m].
            gain: Spring gain [1/s].
            max_speed: Longer commands are scaled to this speed [m/s], keeping their direction.
            sensing_range: Farther robots are not seen [m].
            odd_gain: Gain of the odd spring [1/s].

        Raises:
            ConfigurationError: If a value is not positive, or ``odd_gain`` is negative.
        """
        for name, value in (
            ("distance", distance),
            ("gain", gain),
            ("max_speed", max_speed),
            ("sensing_range", sensing_range),
        ):
            require(value > 0, f"{name} is {value}; it must be positive")
        for name, value in (("distance", distance), ("gain", gain), ("odd_gain", odd_gain)):
            require(0 <= value < np.inf, f"{name} is {value}; it must be finite and not negative")
        self.distance = distance
        self.gain = gain
        self.max_speed = max_speed
        self.sensing_range = sensing_range
        self.odd_gain = odd_gain

    @classmethod
    def named(cls, name: str, distance: float = 1.0) -> Expert:
        """Make one of ``EXPERTS``.

        Raises:
            ConfigurationError: If there is none of that name, or ``distance`` is not positive.
        """
        variant = expert_variant(name)
        return cls(distance, sensing_range=variant.sensing_range, odd_gain=variant.odd_gain)

    @property
    def description(self) -> dict[str, Any]:
        """Name, ``custom`` if it is none of ``EXPERTS``, and settings; an unlimited sensing range is ``None``."""
        variant = ExpertVariant(self.sensing_range, self.odd_gain)
        return {
            "name": next((name for name, known in EXPERTS.items() if known == variant), "custom"),
            "distance": self.distance,
            "gain": self.gain,
            "odd_gain": self.odd_gain,
            "max_speed": self.max_speed,
            "sensing_range": None if np.isinf(self.sensing_range) else self.sensing_range,
        }

    def command(self, view: PrivilegedView) -> FloatArray:
        """Return body twists (B, N, 3) from true poses.

        Raises:
            TriformError: If the view carries no poses, or poses that are not finite.
        """
        poses, active = true_poses(view, "the expert"), np.ascontiguousarray(view.active)
        springs = Springs(self.distance, self.gain, self.odd_gain, self.max_speed, self.sensing_range)
        out = np.zeros(poses.shape)
        worlds, robots = active.shape
        if robots <= SMALL_TEAM or worlds >= usable_threads():
            in_parts(
                lambda first, last: expert_worlds(poses, active, springs, out, first, last),
                worlds, active.size, ROBOTS_PER_THREAD,
            )  # fmt: skip
            return out
        for b in range(worlds):
            self._command_large(poses[b], active[b], springs, out[b])
        return out

    @staticmethod
    def _command_large(poses: FloatArray, active: BoolArray, springs: Springs, out: FloatArray) -> None:
        """Write the body twists of one world, its cells shared out over the threads."""
        world = make_cells(poses, active)
        cells = list_cells(world)
        in_parts(
            lambda first, last: _expert_cells(world, cells[first:last], poses, springs, out),
            len(cells), len(active), ROBOTS_PER_THREAD,
        )  # fmt: skip
