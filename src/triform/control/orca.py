"""ORCA between any controller and the wheels: a baseline for the safety filter, which sees what no robot can.

Optimal reciprocal collision avoidance (van den Berg, Guy, Lin and Manocha, "Reciprocal n-body collision avoidance",
2011) takes robots for discs and every command for a preferred velocity. Of two robots, each takes half of the
smallest change after which their discs do not touch within ``time_horizon`` if both keep their velocities; the command
becomes the nearest velocity that all these half-planes allow, or the one that violates them least if none does. Walls
and pillars are the robot's own business alone.

What it knows is exact: true poses, and velocities from where robots were one command before. What it assumes is not:
robots take up a velocity at once, so a base with a lag or slow acceleration may touch another, and every robot does its
half, so one that is stuck may be touched. Nothing is drawn at random, so two robots that drive straight at each other
get past only once rounding takes them off their line. The library computes in single precision.
"""

from __future__ import annotations

import importlib
import math
import threading
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from triform.control.loop import true_poses
from triform.types import (
    BoolArray,
    ConfigurationError,
    Controller,
    FloatArray,
    PrivilegedView,
    as_array,
    convert_fields,
    require,
)

#: Corners of the polygon around a pillar.
_CORNERS = 16
#: More neighbours than any robot has.
_ALL_NEIGHBOURS = 1_000_000
#: Where robots wait that do not exist, and how far apart [m].
_FAR = 1e5
#: Who seems this many times as fast as the base allows was put where it is, and rests.
_PUT = 2.0


@dataclass(frozen=True)
class OrcaSettings:
    """Settings of ORCA.

    Attributes:
        radius: Radius of the disc that stands for a robot [m].
        period: Time between two commands [s]; robots whose discs overlap part within it.
        time_horizon: For how long a velocity must be safe [s]. Two robots approach each other no faster than the gap
            between their discs in this time.
        max_speed: The drive shortens faster commands to this speed [m/s].
        max_axis_speed: Then it clips both axes by themselves to this speed [m/s].
    """

    radius: float
    period: float = 0.1
    time_horizon: float = 1.0
    max_speed: float = 0.5
    max_axis_speed: float = math.inf

    def __post_init__(self) -> None:
        convert_fields(self)
        for name, unit in (("radius", "m"), ("period", "s"), ("time_horizon", "s")):
            value = getattr(self, name)
            require(0 < value < math.inf, f"{name} is {value} {unit}; it must be positive and finite")
        require(self.max_speed > 0, f"max_speed is {self.max_speed} m/s; it must be positive")
        require(self.max_axis_speed > 0, f"max_axis_speed is {self.max_axis_speed} m/s; it must be positive")
        require(self.largest_speed < math.inf, "max_speed and max_axis_speed are inf; ORCA needs a limit of speed")

    @property
    def largest_speed(self) -> float:
        """The fastest that the base drives in any direction [m/s]."""
        return min(self.max_speed, math.sqrt(2) * self.max_axis_speed)

    @property
    def neighbour_distance(self) -> float:
        """Distance between two centres beyond which robots cannot touch within ``time_horizon`` [m]."""
        return 2 * (self.radius + self.largest_speed * self.time_horizon)


@dataclass
class _Memory:
    """What is remembered of B runs from one command to the next.

    Attributes:
        simulators: A simulator of the library for each run, with an agent for each robot.
        time: Time of the last view [s].
        poses: Its poses, shape (B, N, 3) [m, m, rad].
        active: Which robots it had, shape (B, N).
    """

    simulators: list[Any]
    time: float
    poses: FloatArray
    active: BoolArray


class OrcaFilter:
    """Any controller, its commands changed by ORCA: a ``Controller[PrivilegedView]``.

    A command that ORCA allows is passed on to the bit, and turn rates always are. Each thread remembers the runs that
    it steers; when time goes back, or the number of runs differs, others begin, and their robots rest.

    Attributes:
        controller: The controller whose commands it takes.
    """

    privileged = True

    def __init__(
        self,
        controller: Controller[Any],
        settings: OrcaSettings,
        walls: ArrayLike = (),
        pillars: ArrayLike = (),
    ) -> None:
        """Put ORCA behind a controller.

        Args:
            controller: Any controller; it gets the view unchanged.
            settings: Settings of ORCA.
            walls: Segments x1, y1, x2, y2, shape (W, 4) [m].
            pillars: Circles x, y, radius, shape (K, 3) [m].

        Raises:
            ConfigurationError: The library is not installed.
        """
        self.controller = controller
        self._settings = settings
        self._walls, self._pillars = (
            as_array(name, given).reshape(-1, columns)
            for name, given, columns in (("walls", walls, 4), ("pillars", pillars, 3))
        )
        self._library = _import_library()
        self._local = threading.local()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.controller, self._settings, self._walls, self._pillars)

    @property
    def description(self) -> dict[str, Any]:
        """What the controller says, and the settings of ORCA as ``orca``; no limit is ``None``."""
        settings = {name: None if value == math.inf else value for name, value in asdict(self._settings).items()}
        return {**self.controller.description, "orca": settings}

    def command(self, view: PrivilegedView) -> FloatArray:
        """Return body twists, shape (B, N, 3).

        Raises:
            TriformError: The view carries no poses.
        """
        active = np.array(view.active)
        poses = np.where(active[..., None], true_poses(view, "ORCA"), 0.0)
        commands = np.where(active[..., None], self.controller.command(view), 0.0)
        velocities = self._follow(view.time, poses, active)
        wanted = _turned(self._driven(commands[..., :2]), poses[..., 2])
        chosen = np.zeros_like(wanted)
        for simulator, *world in zip(
            self._local.memory.simulators, poses[..., :2], velocities, wanted, active, chosen, strict=True
        ):
            self._step(simulator, *world)
        changed = active & ~np.isclose(chosen, wanted, rtol=1e-6, atol=1e-6).all(axis=-1)
        commands[changed, :2] = _turned(chosen, -poses[..., 2])[changed]
        return commands

    def _driven(self, translations: FloatArray) -> FloatArray:
        """Return translations, shape (..., 2), as a holonomic base drives them [m/s]."""
        limit, axis_limit = self._settings.max_speed, self._settings.max_axis_speed
        speeds = np.hypot(translations[..., 0], translations[..., 1])[..., None]
        shortened = np.where(speeds > limit, translations * (limit / np.maximum(speeds, limit)), translations)
        return np.clip(shortened, -axis_limit, axis_limit)

    def _follow(self, time: float, poses: FloatArray, active: BoolArray) -> FloatArray:
        """Remember a view, and return how fast robots have moved since the last one, shape (B, N, 2) [m/s]."""
        velocities = np.zeros((*active.shape, 2))
        last: _Memory | None = getattr(self._local, "memory", None)
        if last is None or time <= last.time or len(last.poses) != len(poses) or last.poses.shape[1] > poses.shape[1]:
            simulators = [self._make_simulator() for _ in poses]
        else:
            simulators, known = last.simulators, last.poses.shape[1]
            moved = (poses[:, :known, :2] - last.poses[..., :2]) / (time - last.time)
            drove = np.hypot(moved[..., 0], moved[..., 1]) <= _PUT * self._settings.largest_speed
            velocities[:, :known] = np.where((active[:, :known] & last.active & drove)[..., None], moved, 0.0)
        for simulator in simulators:
            while simulator.get_num_agents() < poses.shape[1]:
                simulator.add_agent((0.0, 0.0))
        self._local.memory = _Memory(simulators, time, poses, active)
        return velocities

    def _make_simulator(self) -> Any:
        settings = self._settings
        simulator = self._library.RVOSimulator(
            settings.period,
            settings.neighbour_distance,
            _ALL_NEIGHBOURS,
            settings.time_horizon,
            settings.time_horizon,
            settings.radius,
            settings.largest_speed,
        )
        for x1, y1, x2, y2 in self._walls.tolist():
            simulator.add_obstacle([(x1, y1), (x2, y2)])
        angles = 2 * np.pi * np.arange(_CORNERS) / _CORNERS
        around = np.stack([np.cos(angles), np.sin(angles)], axis=-1) / np.cos(np.pi / _CORNERS)
        for x, y, radius in self._pillars.tolist():
            simulator.add_obstacle((np.array([x, y]) + radius * around).tolist())
        simulator.process_obstacles()
        return simulator

    def _step(
        self,
        simulator: Any,
        positions: FloatArray,
        velocities: FloatArray,
        wanted: FloatArray,
        active: BoolArray,
        chosen: FloatArray,
    ) -> None:
        """Choose the velocities of one world into ``chosen``, all of shape (N, 2) in the world frame."""
        # Every direction is open up to the speed at which the drive clips none, or to that which is wanted.
        speeds = np.maximum(
            np.hypot(wanted[:, 0], wanted[:, 1]), min(self._settings.max_speed, self._settings.max_axis_speed)
        )
        rows = zip(positions.tolist(), velocities.tolist(), wanted.tolist(), speeds.tolist(), active, strict=True)
        for robot, (position, velocity, preferred, speed, exists) in enumerate(rows):
            simulator.set_agent_position(robot, position if exists else (_FAR * (robot + 1), _FAR))
            simulator.set_agent_velocity(robot, velocity)
            simulator.set_agent_pref_velocity(robot, preferred)
            simulator.set_agent_max_speed(robot, speed)
        simulator.do_step()
        for robot in np.flatnonzero(active).tolist():
            velocity = simulator.get_agent_velocity(robot)
            chosen[robot] = velocity.x, velocity.y


def _turned(vectors: FloatArray, angles: FloatArray) -> FloatArray:
    """Return vectors, shape (..., 2), turned counter-clockwise by angles, shape (...) [rad]."""
    cos, sin = np.cos(angles), np.sin(angles)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _import_library() -> Any:
    try:
        return importlib.import_module("pyrvo")
    except ModuleNotFoundError:
        raise ConfigurationError(
            "ORCA needs pyrvo, which the extra 'orca' installs: pip install 'triform[orca]', or in a checkout "
            "pip install '.[orca]'"
        ) from None
