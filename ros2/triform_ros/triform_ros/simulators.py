"""What the bridge can put on topics: the built-in world, and Gazebo."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from triform.simulation import IDEAL, Arena, Mounting, Profile, World, get_arena, get_profile, world_seeds
from triform.simulators.gazebo import GazeboServer
from triform.types import SIGHT, FloatArray, RangeArray, require

SIMULATORS = ("world", "gazebo")


@dataclass(frozen=True)
class Moment:
    """What is the case after a control period.

    Attributes:
        time: Since the start [s].
        poses: True poses, shape (N, 3) [m, m, rad].
        twists: Body twists, shape (N, 3) [m/s, m/s, rad/s].
        ranges: What every LiDAR, from where it is mounted, has measured in its newest turn, shape (N, R) [m].
        intensities: How bright these returns are, shape (N, R); ``None`` if they are not asked for.
        began: When that turn began [s]; of a LiDAR that measures all rays at once, when it ended.
        collided: Whether two robots have touched or overlapped, in this period or so far.
    """

    time: float
    poses: FloatArray
    twists: FloatArray
    ranges: RangeArray
    intensities: RangeArray | None
    began: float
    collided: bool


class WorldSimulator:
    """The built-in world."""

    def __init__(self, poses: FloatArray, profile: Profile, arena: Arena, seed: int) -> None:
        """Place robots, shape (N, 3) [m, m, rad], whose errors are those of a seed."""
        seeds = world_seeds(len(poses), seed, [0])
        self._world = World(poses[None], profile, arena, seeds, from_lidar=True)

    def step(self, commands: FloatArray) -> Moment:
        """Hold body twists, shape (N, 3), for one control period."""
        world, lidar = self._world, self._world.profile.lidar
        world.apply(commands[None], world.control_period)
        view = world.observe()
        ended = math.floor((world.time - world.profile.latency) / lidar.period + 1e-6) * lidar.period
        began = ended - lidar.period * lidar.rolling
        scans, collided = view.scans, bool(world.collided[0])
        bright = None if scans.intensities is None else scans.intensities[0]
        return Moment(world.time, view.poses[0], world.velocities[0], scans.ranges[0], bright, began, collided)

    def close(self) -> None:
        """There is nothing to end."""


class GazeboSimulator:
    """Gazebo in lock-step; a control period is a whole number of steps of its physics, and so is a turn."""

    def __init__(self, poses: FloatArray, profile: Profile, arena: Arena, seed: int) -> None:  # noqa: ARG002
        """Start Gazebo and place robots, shape (N, 3) [m, m, rad].

        Raises:
            TriformError: Gazebo is missing or does not start, or it cannot simulate these robots.
        """
        profile.require_holonomic("Gazebo")
        in_step = profile.lidar.period == profile.control_period and not profile.lidar.rolling
        require(
            in_step and profile.mounting == Mounting() and profile.lidar.min_intensity is None,
            f"the profile {profile.name!r} has a LiDAR off the centre, out of step with the commands, or with a "
            "min_intensity, which the bridge to Gazebo does not simulate; simulator:=world does",
        )
        self._server = GazeboServer(profile, arena, len(poses), time_step=profile.time_step)
        self._steps = round(profile.control_period / profile.time_step)
        self._server.reset(poses)

    def step(self, commands: FloatArray) -> Moment:
        """Hold body twists, shape (N, 3), for one control period.

        Raises:
            GazeboError: Gazebo has ended or hangs.
        """
        state = self._server.step(commands, self._steps)
        assert state.ranges is not None
        return Moment(state.time, state.poses, state.twists, state.ranges, None, state.time, state.touched)

    def close(self) -> None:
        """End Gazebo."""
        self._server.close()


def bridge_profile(name: str, rate: float, distance: float) -> Profile:
    """Return the robots of the bridge, which look 2 d* far and are commanded ``rate`` times a second.

    Args:
        name: Their profile, a name or a TOML file; if empty they are ideal ones, with as many scans as commands.
        rate: Commands per second [Hz].
        distance: Prescribed neighbour distance d* [m].

    Raises:
        ConfigurationError: There is no such profile.
    """
    period = 1 / rate
    profile = get_profile(name) if name else replace(IDEAL, lidar=replace(IDEAL.lidar, period=period))
    time_step = period / math.ceil(period / profile.time_step - 1e-9)
    return replace(profile, control_period=period, time_step=time_step).seeing(SIGHT * distance)


def open_simulator(
    name: str, poses: FloatArray, profile: Profile, arena: str, seed: int
) -> WorldSimulator | GazeboSimulator:
    """Start a simulator.

    Args:
        name: One of ``SIMULATORS``.
        poses: Where the robots start, shape (N, 3) [m, m, rad].
        profile: Kind of all robots.
        arena: Name of the arena.
        seed: Of the robots' errors.

    Raises:
        TriformError: There is no such simulator or arena, or Gazebo cannot be started.
    """
    require(name in SIMULATORS, f"there is no simulator {name!r}; there are {', '.join(SIMULATORS)}")
    return (WorldSimulator if name == "world" else GazeboSimulator)(poses, profile, get_arena(arena), seed)
