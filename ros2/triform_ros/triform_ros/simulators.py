"""What the bridge can put on topics: the built-in world, and Gazebo."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from triform.simulation import IDEAL, Arena, Profile, World, get_arena
from triform.simulators.gazebo import GazeboServer
from triform.types import SENSING_RANGE, FloatArray, RangeArray, require

SIMULATORS = ("world", "gazebo")


@dataclass(frozen=True)
class Moment:
    """What is the case after a control period.

    Attributes:
        poses: True poses, shape (N, 3) [m, m, rad].
        twists: Body twists, shape (N, 3) [m/s, m/s, rad/s].
        ranges: What every LiDAR measures now, shape (N, R) [m].
    """

    poses: FloatArray
    twists: FloatArray
    ranges: RangeArray


class WorldSimulator:
    """The built-in world."""

    def __init__(self, poses: FloatArray, profile: Profile, arena: Arena) -> None:
        """Place robots, shape (N, 3) [m, m, rad]."""
        self._world = World(poses[None], profile, arena)

    def step(self, commands: FloatArray) -> Moment:
        """Hold body twists, shape (N, 3), for one control period."""
        self._world.apply(commands[None], self._world.control_period)
        view = self._world.observe()
        return Moment(view.poses[0], self._world.velocities[0], view.scans.ranges[0])

    def close(self) -> None:
        """There is nothing to end."""


class GazeboSimulator:
    """Gazebo in lock-step; a control period is a whole number of steps of its physics."""

    def __init__(self, poses: FloatArray, profile: Profile, arena: Arena) -> None:
        """Start Gazebo and place robots, shape (N, 3) [m, m, rad].

        Raises:
            GazeboError: Gazebo is missing or does not start.
        """
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
        return Moment(state.poses, state.twists, state.ranges)

    def close(self) -> None:
        """End Gazebo."""
        self._server.close()


def bridge_profile(rate: float, distance: float) -> Profile:
    """Return ideal robots that are commanded, and look 2 d* far, ``rate`` times a second."""
    period = 1 / rate
    scan = replace(IDEAL.lidar.scan, range_max=SENSING_RANGE * distance)
    lidar = replace(IDEAL.lidar, scan=scan, period=period)
    time_step = period / math.ceil(period / IDEAL.time_step - 1e-9)
    return replace(IDEAL, control_period=period, lidar=lidar, time_step=time_step)


def open_simulator(name: str, poses: FloatArray, profile: Profile, arena: str) -> WorldSimulator | GazeboSimulator:
    """Start a simulator.

    Args:
        name: One of ``SIMULATORS``.
        poses: Where the robots start, shape (N, 3) [m, m, rad].
        profile: Kind of all robots.
        arena: Name of the arena.

    Raises:
        TriformError: There is no such simulator or arena, or Gazebo cannot be started.
    """
    require(name in SIMULATORS, f"there is no simulator {name!r}; there are {', '.join(SIMULATORS)}")
    return (WorldSimulator if name == "world" else GazeboSimulator)(poses, profile, get_arena(arena))
