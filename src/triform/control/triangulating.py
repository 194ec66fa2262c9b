"""The triangulating law: a local law after which every triangle is closed, from what one robot can see."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from triform.control.loop import true_poses
from triform.control.triangulating_kernels import LawConstants, hidden, law_workspace, triangulate
from triform.geometry.cells import SEARCH_DEPTH, SMALL_TEAM, find_near, list_cells, make_cells
from triform.kernels import kernel
from triform.threads import in_parts
from triform.types import FloatArray, PrivilegedView, convert_fields, require

#: Robots whose commands keep a thread busy for a few milliseconds.
_ROBOTS_PER_THREAD = 3_000
#: Half the mean width of a RoboMaster EP: a disc of this radius around a robot hides who is behind it [m].
BLOCKING_RADIUS = 0.14


@dataclass(frozen=True)
class TriangulatingLaw:
    """Constants of the law; lengths in d*, speeds in d*/s, gains in 1/s, angles in rad. See docs/triangulating.md.

    The *strain* of an edge is its length minus 1. A *bridge* is an edge to a Gabriel neighbour with whom the robot
    shares no other: an edge without a triangle.

    Attributes:
        sight: Farther robots are not seen.
        contact_gain: Repulsion from robots nearer than ``contact_range``.
        contact_range: Where it begins.
        gain: Spring to neighbours; it also repels others that are nearer than 1.
        yield_strain: Strain beyond which the pull grows no more, so that bad edges break.
        yield_slope: How fast the pull falls beyond it.
        far_range: Length beyond which an edge pulls more again, so that nobody is lost.
        far_gain: Gain of that pull.
        odd_gain: Odd spring: a force at +90 degrees to every edge, zero at rest; it makes defects wander.
        compaction_speed: Towards the centre of all in sight while edges near by are loose.
        loose_length: Length from which an edge is loose.
        loose_width: Over which looseness grows from 0 to 1.
        squeeze_limit: Compression of its shortest edge at which the compaction of a robot begins to fade.
        squeeze_width: Over which it fades to nothing.
        bridge_pull: Towards the others in sight while the robot has a bridge and no triangle.
        bridge_push: Amplitude of the exploration noise while the robot has a bridge.
        hinge_pull: Towards every robot that hangs from one of its neighbours by a bridge, as far as it sees.
        firm_degree: Edges to robots with at most as many neighbours do not yield.
        strain_push: Amplitude of the exploration noise while an edge is too long or too short.
        strain_limit: Strain at which that noise begins.
        strain_width: Over which it grows to its full amplitude.
    """

    sight: float = 3.0
    contact_gain: float = 8.0
    contact_range: float = 0.7
    gain: float = 3.0
    yield_strain: float = 0.065
    yield_slope: float = 0.26
    far_range: float = 1.28
    far_gain: float = 1.4
    odd_gain: float = 1.6
    compaction_speed: float = 0.5
    loose_length: float = 1.14
    loose_width: float = 0.1
    squeeze_limit: float = 0.08
    squeeze_width: float = 0.08
    bridge_pull: float = 0.35
    bridge_push: float = 0.3
    hinge_pull: float = 0.5
    firm_degree: float = 2.0
    strain_push: float = 0.3
    strain_limit: float = 0.09
    strain_width: float = 0.03

    def __post_init__(self) -> None:
        convert_fields(self)
        for each in fields(self):
            value = getattr(self, each.name)
            require(0 <= value < np.inf, f"{each.name} of the law is {value}; it must be finite and not negative")
        for name in ("sight", "loose_width", "squeeze_width", "strain_width"):
            require(getattr(self, name) > 0, f"{name} of the law is {getattr(self, name)}; it must be positive")

    @property
    def constants(self) -> LawConstants:
        """The constants as kernels take them."""
        return LawConstants(*(float(getattr(self, each.name)) for each in fields(self)))


class _Settings(NamedTuple):
    """What the controller is told beside the law.

    Attributes:
        distance: Prescribed neighbour distance d* [m].
        blocking: Radius of the disc around a robot that hides who is behind it [m].
        max_speed: Longer commands are scaled to this speed [m/s].
    """

    distance: float
    blocking: float
    max_speed: float


@kernel
def _command_one(i, candidates, number, poses, law, settings, noise, workspace, out):
    """Write the body twist of robot i, which looks at the first ``number`` robots of ``candidates``."""
    distance, blocking, max_speed = settings
    x, y, all_x, all_y = workspace.x, workspace.y, workspace.all_x, workspace.all_y
    reach = law.sight * distance
    cos, sin = np.cos(poses[i, 2]), np.sin(poses[i, 2])
    all_x[0] = all_y[0] = x[0] = y[0] = 0.0
    near = 1
    for k in range(number):
        j = candidates[k]
        d_x, d_y = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
        if j != i and d_x * d_x + d_y * d_y <= reach * reach:
            all_x[near] = (cos * d_x + sin * d_y) / distance
            all_y[near] = (cos * d_y - sin * d_x) / distance
            near += 1
    count = 1
    for k in range(1, near):
        if blocking == 0.0 or not hidden(all_x, all_y, near, k, blocking / distance):
            x[count], y[count] = all_x[k], all_y[k]
            count += 1
    v_x, v_y, amplitude = triangulate(count, law, workspace)
    v_x = distance * (v_x + amplitude * noise[i, 0])
    v_y = distance * (v_y + amplitude * noise[i, 1])
    speed = np.sqrt(v_x * v_x + v_y * v_y)
    scale = max_speed / speed if speed > max_speed else 1.0
    out[i, 0], out[i, 1], out[i, 2] = scale * v_x, scale * v_y, 0.0


@kernel
def _command_worlds(poses, active, law, settings, noise, out, first, last):
    """Write the body twists of the worlds ``first <= b < last``; every per-robot array has the leading axis B."""
    robots = poses.shape[1]
    reach = (law.sight * settings.distance) ** 2
    workspace = law_workspace(robots + 1 if robots <= SMALL_TEAM else 1)
    present = np.empty(robots, dtype=np.int64)
    for b in range(first, last):
        out[b] = 0.0
        if robots <= SMALL_TEAM:
            number = 0
            for j in range(robots):
                if active[b, j]:
                    present[number] = j
                    number += 1
            for k in range(number):
                _command_one(present[k], present, number, poses[b], law, settings, noise[b], workspace, out[b])
            continue
        world = make_cells(poses[b], active[b])
        in_slots, _, parts, _ = world
        stack, near = np.empty(SEARCH_DEPTH, dtype=np.int64), np.empty(in_slots.shape[0], dtype=np.int64)
        for cell in list_cells(world):
            number = find_near(world, cell, reach, stack, near)
            for k in range(number):
                near[k] = in_slots[near[k]]
            # In growing order of the robots, so that sums do not depend on the cells.
            near[:number].sort()
            if number >= workspace.x.shape[0]:
                workspace = law_workspace(2 * number + 1)
            for own in range(parts[cell, 0], parts[cell, 1]):
                _command_one(in_slots[own], near, number, poses[b], law, settings, noise[b], workspace, out[b])


class Triangulating:
    """The triangulating law on true positions within sight, a ``Controller[PrivilegedView]``.

    A robot sees those within ``law.sight`` d* whom nobody stands in front of, and nothing else. Robots do not turn.
    """

    privileged = True

    def __init__(
        self,
        distance: float = 1.0,
        max_speed: float = 0.5,
        law: TriangulatingLaw | None = None,
        blocking_radius: float = BLOCKING_RADIUS,
    ) -> None:
        """Make the controller.

        Args:
            distance: Prescribed neighbour distance d* [m].
            max_speed: Longer commands are scaled to this speed [m/s], keeping their direction.
            law: Constants; the tuned ones if omitted.
            blocking_radius: A robot hides who is behind a disc of this radius around it [m]; 0 lets all be seen.

        Raises:
            ConfigurationError: If a value is not allowed.
        """
        require(0 < distance < np.inf, f"distance is {distance} m; it must be positive and finite")
        require(max_speed > 0, f"max_speed is {max_speed} m/s; it must be positive")
        require(
            0 <= blocking_radius < np.inf, f"blocking_radius is {blocking_radius} m; it must be finite, not negative"
        )
        self.law = TriangulatingLaw() if law is None else law
        self._settings = _Settings(float(distance), float(blocking_radius), float(max_speed))

    @property
    def description(self) -> dict[str, Any]:
        """Name and settings, plain JSON values."""
        distance, blocking, max_speed = self._settings
        return {
            "name": "triangulating",
            "distance": distance,
            "max_speed": max_speed,
            "blocking_radius": blocking,
            "law": asdict(self.law),
        }

    def command(self, view: PrivilegedView) -> FloatArray:
        """Return body twists (B, N, 3) from true poses.

        Raises:
            TriformError: If the view carries no poses, or poses that are not finite.
        """
        poses, active = true_poses(view, "the triangulating law"), np.ascontiguousarray(view.active)
        noise = np.zeros((*active.shape, 2)) if view.noise is None else np.ascontiguousarray(view.noise)
        out = np.empty(poses.shape)
        in_parts(
            lambda first, last: _command_worlds(
                poses, active, self.law.constants, self._settings, noise, out, first, last
            ),
            len(poses), active.size, _ROBOTS_PER_THREAD,
        )  # fmt: skip
        return out
