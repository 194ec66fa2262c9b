"""A filter between any controller and the wheels: no robot drives into what its own scan shows.

Every return of the newest scan at a gap g from the robot's own outline, along the unit vector n, allows the velocities
``n . u <= rate * max(g - min_gap, 0)``: a control barrier function, as a half-plane. The command becomes the nearest
velocity that all half-planes allow.

Why robots keep apart. The filter cannot know that another robot moves, so each takes half of what is left. Let X be the
gap of two guarded robots beyond ``min_gap``. A command that is still driven may rest on a scan as old as ``reaction``,
so ``X'(t) >= -2 rate X(t - s)`` with ``s <= reaction``. With ``rate = 1 / (2 e reaction)`` X never shrinks faster than
``exp(-t / reaction)``: as long as it has not, ``X(t - s) <= e X(t)``, so ``X' >= -X / reaction``. So X stays positive,
whatever the controllers want, if it was when the robots stood. This holds exactly for motion along one line; for bodies
that pass each other, whose nearest points move along them, it is a rule that experiments confirm.

Zero is always allowed, so the filter never makes a command longer, never moves a robot that wants to rest, and never
has to choose between two dangers. It does not push robots apart that are nearer than ``min_gap``, and it does not plan:
two robots that want to change places stop in front of each other.

Noise. The median of each ray and its neighbours counts, so what one ray alone shows, near or far, does nothing.
Otherwise no allowance is made: a side that many rays measure acts by its nearest one, so noise makes robots cautious.
``min_gap`` covers the rest: corners that few rays measure, and corners between two rays.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Generic

import numpy as np

from triform.control.detection import ROBOMASTER_EP_SIZE, kernel_footprint, ray_directions
from triform.control.safety_kernels import SafetyRules, filter_robots
from triform.threads import in_parts
from triform.types import Controller, FloatArray, ViewIn, convert_fields, require

#: Robots whose scans keep a thread busy for a few milliseconds.
ROBOTS_PER_THREAD = 4000


def reaction_time(
    control_period: float, scan_period: float, latency: float = 0.0, rolling: bool = False, lag: float = 0.0
) -> float:
    """Return how old a measurement can be while a command that rests on it is still driven [s].

    A scan is observed when it is up to ``latency + scan_period`` old, the first rays of a rolling one are older by a
    further ``scan_period``, and the command is held for ``control_period``. A first-order lag of the drive acts as
    half as much again of delay: ``rate`` then keeps the condition for motion without overshoot.

    Args:
        control_period: Time between two commands [s].
        scan_period: Time between two scans [s].
        latency: Time from a finished scan until a command can use it [s].
        rolling: Whether each ray is measured at its own moment of a turn.
        lag: Time constant of the drive [s].
    """
    return latency + (2 if rolling else 1) * scan_period + control_period + 1.5 * lag


@dataclass(frozen=True)
class SafetySettings:
    """Settings of the filter.

    Attributes:
        footprint: Length and width of the robots' box, or the diameter of a circle [m].
        min_gap: Gap that robots keep [m].
        reaction: Greatest age of a measurement that a command still rests on [s], see ``reaction_time``. The default
            is that of scans and commands every 0.1 s and a latency of 0.2 s.
        max_speed: The drive shortens faster commands to this speed [m/s].
        max_axis_speed: Then it clips both axes by themselves to this speed [m/s], which may turn a command. Commands
            are judged as the drive will carry them out.
    """

    footprint: tuple[float, float] | float = ROBOMASTER_EP_SIZE
    min_gap: float = 0.05
    reaction: float = 0.4
    max_speed: float = math.inf
    max_axis_speed: float = math.inf

    def __post_init__(self) -> None:
        convert_fields(self)
        kernel_footprint(self.footprint)
        require(0 <= self.min_gap < math.inf, f"min_gap is {self.min_gap} m; it must be finite and not negative")
        require(0 < self.reaction < math.inf, f"reaction is {self.reaction} s; it must be positive and finite")
        require(self.max_speed > 0, f"max_speed is {self.max_speed} m/s; it must be positive")
        require(self.max_axis_speed > 0, f"max_axis_speed is {self.max_axis_speed} m/s; it must be positive")

    @property
    def rate(self) -> float:
        """Speed allowed towards a return, per gap beyond ``min_gap`` [1/s]."""
        return 1 / (2 * math.e * self.reaction)


class SafetyFilter(Generic[ViewIn]):
    """Any controller, its commands limited by what each robot's own scan shows: a controller for the same views.

    A command that is allowed is passed on to the bit. A robot whose scan holds no measurement stands still. So does
    one that has seen no return within the first ``reaction`` of a run, because its first scan may not be there yet;
    a robot that joins a running team is not known to the filter, and drives blind until its first scan.

    A command that turns is limited for the circle around the footprint instead, so that no corner sweeps into what
    stands outside it, and the robot does not turn while a return lies within. That circle may reach over what stands
    beside the robot, and the bound takes no account of how much the robot turns in ``reaction``: no controller of this
    package turns, and the filter is not tested for overlaps of robots that do.
    """

    def __init__(self, controller: Controller[ViewIn], guard: SafetySettings | None = None) -> None:
        """SafetySettings a controller.

        Args:
            controller: Any controller; it gets the view unchanged.
            guard: Settings of the filter; by default those of a RoboMaster EP.
        """
        self._controller = controller
        self._guard = guard or SafetySettings()

    @property
    def privileged(self) -> bool:
        """Whether the guarded controller needs a ``PrivilegedView``."""
        return self._controller.privileged

    @property
    def description(self) -> dict[str, Any]:
        """What the guarded controller says, and the settings of the filter as ``guard``; no limit is ``None``."""
        settings = {name: None if value == math.inf else value for name, value in asdict(self._guard).items()}
        half_length, half_width, is_circle = kernel_footprint(self._guard.footprint)
        shape = "circle" if is_circle else "box"
        settings["footprint"] = {"shape": shape, "length": 2 * half_length, "width": 2 * half_width}
        return {**self._controller.description, "guard": settings}

    def command(self, view: ViewIn) -> FloatArray:
        """Return body twists, shape (B, N, 3)."""
        guard, config = self._guard, view.scans.config
        commands = np.array(self._controller.command(view), dtype=np.float64, order="C")
        ranges = np.ascontiguousarray(view.scans.ranges).reshape(-1, config.rays)
        active = np.ascontiguousarray(view.active).reshape(-1)
        body = kernel_footprint(guard.footprint)
        circumradius = body.half_length if body.is_circle else math.hypot(body.half_length, body.half_width)
        law = SafetyRules(
            ray_directions(view.scans),
            config.range_min,
            config.range_max,
            body,
            circumradius,
            guard.rate,
            guard.min_gap,
            guard.max_speed,
            guard.max_axis_speed,
        )
        early = view.time < guard.reaction
        flat = commands.reshape(-1, 3)
        in_parts(
            lambda first, last: filter_robots(ranges, active, law, early, flat, first, last),
            len(flat), len(flat), ROBOTS_PER_THREAD,
        )  # fmt: skip
        return commands
