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

A differential base drives along its axis alone, so only its speed is limited, by every return: to
``rate * max(g - min_gap, 0) / cos(b)``, with b the bearing of the return from the direction of travel, less the angle
by which the robot can turn before the command ends (``Arcs``); a return with b beyond 90 degrees limits nothing. Gap
and bearing are those from where the robot comes to rest, which its odometry tells; without odometry the angle grows by
the fastest turn in ``reaction``. So however the robot turns, it never drives at a return faster than a holonomic one
may, and the argument above holds. A differential robot is to the filter the circle around its outline, and so are the
others: a box adds to ``min_gap`` what its corners stand out. A circle may turn at any time.

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
from triform.control.safety_kernels import (
    Arcs,
    SafetyRules,
    filter_robots,
    filter_rolling,
    free_rolling_into,
    free_speeds_into,
)
from triform.geometry.unicycle import Wheels
from triform.threads import in_parts
from triform.types import Controller, FloatArray, IntArray, View, ViewIn, convert_fields, require

#: Robots whose scans keep a thread busy for a few milliseconds.
ROBOTS_PER_THREAD = 4000
#: Directions around a holonomic robot in which free velocities are looked for.
_DIRECTIONS = 120


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


def rolling_arcs(wheels: Wheels, control_period: float, turn_lag: float, unknown: float = 0.0) -> Arcs:
    """Return what a differential base does between a decision and its effect.

    Args:
        wheels: Its limits.
        control_period: Time between two commands [s].
        turn_lag: How long its fastest turn would have to go on to come as far as it does in stopping [s].
        unknown: How long it may have turned without knowing it [s]: 0 with odometry, else the ``reaction``.
    """
    return Arcs(wheels, control_period + turn_lag, wheels.max_turn_rate * (turn_lag + unknown))


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
        pace: Share of every command that is driven, because of how late robots know: see ``triform.simulation.pace``.
            A differential base turns more slowly, too.
        arcs: What a differential base does with a command, see ``rolling_arcs``; ``None`` for a holonomic one.
    """

    footprint: tuple[float, float] | float = ROBOMASTER_EP_SIZE
    min_gap: float = 0.05
    reaction: float = 0.4
    max_speed: float = math.inf
    max_axis_speed: float = math.inf
    pace: float = 1.0
    arcs: Arcs | None = None

    def __post_init__(self) -> None:
        convert_fields(self)
        kernel_footprint(self.footprint)
        require(0 <= self.min_gap < math.inf, f"min_gap is {self.min_gap} m; it must be finite and not negative")
        require(0 < self.reaction < math.inf, f"reaction is {self.reaction} s; it must be positive and finite")
        require(self.max_speed > 0, f"max_speed is {self.max_speed} m/s; it must be positive")
        require(self.max_axis_speed > 0, f"max_axis_speed is {self.max_axis_speed} m/s; it must be positive")
        require(0 < self.pace <= 1, f"pace is {self.pace}; it is a share above 0 and at most 1")

    @property
    def rate(self) -> float:
        """Speed allowed towards a return, per gap beyond ``min_gap`` [1/s]."""
        return 1 / (2 * math.e * self.reaction)


class SafetyFilter(Generic[ViewIn]):
    """Any controller, its commands limited by what each robot's own scan shows: a controller for the same views.

    A command that is allowed is passed on to the bit; of robots that know late, a share of it, their ``pace``. A robot
    whose scan holds no measurement stands still. So does one that has seen no return within the first ``reaction`` of a
    run, because its first scan may not be there yet; a robot that joins a running team is not known to the filter, and
    drives blind until its first scan.

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
        settings = asdict(self._guard)
        arcs = settings.pop("arcs")
        if arcs is not None:
            settings |= {"hold": arcs.hold, "slack": arcs.slack, "wheels": arcs.wheels._asdict()}
            settings["wheels"]["max_wheel_speed"] = _finite(arcs.wheels.max_wheel_speed)
        settings = {name: _finite(value) for name, value in settings.items()}
        half_length, half_width, is_circle = kernel_footprint(self._guard.footprint)
        shape = "circle" if is_circle else "box"
        settings["footprint"] = {"shape": shape, "length": 2 * half_length, "width": 2 * half_width}
        return {**self._controller.description, "guard": settings}

    def command(self, view: ViewIn) -> FloatArray:
        """Return body twists, shape (B, N, 3)."""
        return self.decide(view)[1]

    def decide(self, view: ViewIn) -> tuple[FloatArray, FloatArray]:
        """Return the body twists that the controller wants and those that are allowed, each of shape (B, N, 3)."""
        wanted = self._controller.command(view)
        return wanted, self.limit(view, wanted)

    def limit(self, view: ViewIn, wanted: FloatArray) -> FloatArray:
        """Return body twists (B, N, 3) that another controller wants, as this filter limits them."""
        return limit_by_scans(view, wanted, self._guard)


def limit_by_scans(view: View, wanted: FloatArray, guard: SafetySettings) -> FloatArray:
    """Return body twists as limited by what each robot's own scan shows.

    Args:
        view: What robots sense.
        wanted: Body twists, shape (B, N, 3) [m/s, m/s, rad/s].
        guard: Settings of the filter.

    Returns:
        Body twists, shape (B, N, 3).
    """
    arcs = guard.arcs
    commands = np.array(wanted, dtype=np.float64, order="C")
    ranges = np.ascontiguousarray(view.scans.ranges).reshape(-1, view.scans.config.rays)
    active = np.ascontiguousarray(view.active).reshape(-1)
    resting = np.zeros((len(active), 3)) if view.odometry is None else view.odometry.reshape(-1, 3)
    law, early = _rules(view, guard), view.time < guard.reaction
    flat = commands.reshape(-1, 3)

    def limit(first: int, last: int) -> None:
        if arcs is None:
            filter_robots(ranges, active, law, early, flat, first, last)
        else:
            filter_rolling(ranges, active, law, arcs, early, resting, flat, first, last)

    in_parts(limit, len(flat), len(flat), ROBOTS_PER_THREAD)
    return commands


def free_velocities(
    view: View, robot: int, guard: SafetySettings, turn: float, largest: float
) -> tuple[FloatArray, IntArray]:
    """Return the edge of the velocities that the filter allows one robot of the first world.

    Args:
        view: What robots sense.
        robot: Index of the robot along axis N.
        guard: Settings of the filter.
        turn: How fast the robot turns meanwhile [rad/s].
        largest: Faster velocities are of no interest [m/s].

    Returns:
        In the robot's frame the largest velocities in directions all around, counter-clockwise, shape (K, 2) [m/s], or
        of a differential base those forwards and backwards, K = 2; and the ray whose return limits each, -1 for none,
        shape (K,).
    """
    arcs, law, early = guard.arcs, _rules(view, guard), view.time < guard.reaction
    ranges = np.ascontiguousarray(view.scans.ranges[0, robot])
    angles = np.linspace(0.0, 2 * np.pi, _DIRECTIONS if arcs is None else 2, endpoint=False)
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    speeds = np.full(len(angles), min(largest, guard.max_speed))
    limiting = np.empty(len(angles), dtype=np.int64)
    if arcs is None:
        # The drive clips each axis by itself.
        speeds = np.minimum(speeds, guard.max_axis_speed / np.abs(directions).max(axis=1))
        free_speeds_into(ranges, law, early, turn != 0.0, angles, speeds, limiting)
    else:
        resting = np.zeros(3) if view.odometry is None else view.odometry[0, robot]
        free_rolling_into(ranges, law, arcs, early, resting, turn, speeds, limiting)
    return speeds[:, None] * directions, limiting


def _rules(view: View, guard: SafetySettings) -> SafetyRules:
    """Return what limits commands that rest on these scans."""
    arcs, config, body = guard.arcs, view.scans.config, kernel_footprint(guard.footprint)
    circumradius = body.half_length if body.is_circle else math.hypot(body.half_length, body.half_width)
    return SafetyRules(
        ray_directions(view.scans),
        config.range_min,
        config.range_max,
        body,
        circumradius,
        guard.rate,
        guard.min_gap if arcs is None else guard.min_gap + circumradius - min(body.half_length, body.half_width),
        guard.max_speed,
        guard.max_axis_speed,
        guard.pace,
    )


def _finite(value: Any) -> Any:
    """Return a value that JSON knows: ``None`` for no limit."""
    return None if value == math.inf else value
