"""Robots in Gazebo as a team that any controller drives, like those of the built-in world."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from triform.simulation.sensors import SensorSuite
from triform.simulators.chassis import braked
from triform.simulators.gazebo.server import GazeboServer, State
from triform.types import BoolArray, FloatArray, PrivilegedView, TriformError, require


class GazeboTeam:
    """One team in Gazebo, B = 1: a ``SimulatedTeam`` with the interface of ``triform.simulation.World``.

    Bodies, contacts and motion are Gazebo's, and so are exact ranges; turns, errors, latency, odometry and
    exploration noise come from ``SensorSuite``, the same as in the built-in world. Everything happens at the end of a
    step of the physics: a moment between two steps is that of the nearest one, and a rolling LiDAR looks once in every
    ``time_step`` of the profile. Robots that touch are recorded as a collision, because solid bodies cannot overlap.

    Attributes:
        profile: Kind of all robots.
        arena: Walls and pillars.
        control_period: Time between two commands [s].
        time: Time since the start [s].
        min_distance: Smallest distance between two centres at any step so far, shape (1,) [m].
        collided: Whether two robots have touched at any step so far, shape (1,).
        hit_arena: Whether a robot has touched a wall or pillar at any step so far, shape (1,).
    """

    def __init__(
        self, server: GazeboServer, poses: ArrayLike, seeds: list[np.random.SeedSequence] | None = None
    ) -> None:
        """Place the robots at rest, which begins a run at time 0.

        Args:
            server: Gazebo, whose robots beyond those of ``poses`` are spare.
            poses: Poses in the world frame, shape (1, N, 3) [m, m, rad].
            seeds: One seed; may be left out if the profile has no random errors.

        Raises:
            ConfigurationError: If there is more than one world, the profile has errors of ray angles or a LiDAR off the
                robot's centre, which Gazebo's cannot have, or a seed is missing.
            TriformError: If Gazebo fails or a pose is not finite.
        """
        placed = np.array(poses, dtype=np.float64)
        require(
            placed.ndim == 3 and placed.shape[0] == 1 and placed.shape[2] == 3 and bool(np.isfinite(placed).all()),
            f"poses of shape {placed.shape} given; finite ones of shape (1, robots, 3) are needed",
        )
        profile = server.profile
        require(profile.lidar.angle_noise == 0, "the rays of Gazebo's LiDAR keep their angles; angle_noise must be 0")
        require(
            profile.mounting.offset == 0, "Gazebo's LiDAR is at the robot's centre; the mounting's x and y must be 0"
        )
        self._server = server
        self.profile, self.arena, self.control_period = profile, server.arena, profile.control_period
        self.newcomer = profile
        self.time = 0.0
        self.min_distance: FloatArray = np.array([math.inf])
        self.collided: BoolArray = np.array([False])
        self.hit_arena: BoolArray = np.array([False])
        self._robots = placed.shape[1]
        self._take(server.reset(placed[0], scan=True))
        sensing = replace(profile, drive=braked(profile.drive))
        self._senses = SensorSuite(sensing, self.poses, self.active, seeds)
        if not profile.lidar.rolling:
            self._senses.finish(self._ranges(), self.poses, self.active)

    @property
    def poses(self) -> FloatArray:
        """True poses in the world frame, shape (1, N, 3) [m, m, rad]; ``NaN`` where not active."""
        return self._state.poses[None, : self._robots].copy()

    @property
    def velocities(self) -> FloatArray:
        """Actual body twists, shape (1, N, 3) [m/s, m/s, rad/s]; zero where not active."""
        return self._state.twists[None, : self._robots].copy()

    @property
    def active(self) -> BoolArray:
        """Which robots exist, shape (1, N)."""
        return self._state.active[None, : self._robots].copy()

    def observe(self) -> PrivilegedView:
        """Return the newest scans whose latency has passed, and everybody's true pose."""
        return self._senses.view(self.time, self.poses, self.velocities, self.active)

    def apply(self, commands: FloatArray, duration: float) -> None:
        """Hold body twists for a while.

        Args:
            commands: Body twists, shape (1, N, 3) [m/s, m/s, rad/s]; those of inactive robots are not used.
            duration: How long [s].

        Raises:
            TriformError: If the shape does not fit, a command is not finite, the duration is not positive, or Gazebo
                fails.
        """
        values = np.asarray(commands, dtype=np.float64)
        if values.shape != (1, self._robots, 3):
            raise TriformError(f"commands of shape {values.shape} given; {(1, self._robots, 3)} is needed")
        targets = np.zeros((len(self._state.active), 3))
        targets[: self._robots] = values[0]
        end = self.time + duration
        for stop, turn_ends in self._senses.stretches(self.time, duration):
            self._advance(targets, stop, turn_ends)
            self.time = stop
            if turn_ends:
                ranges = None if self.profile.lidar.rolling else self._ranges()
                self._senses.end_turn(ranges, self.poses, self.active)
        self.time = end

    def add_robot(self, world: int, pose: ArrayLike) -> int:
        """Add a spare robot at rest and return its index along axis N, which grows if no place is free.

        Raises:
            TriformError: If there is no such world, no spare robot, or the pose is not three finite numbers.
        """
        self._check_world(world)
        robot = self._server.add(pose)
        if robot == self._robots:
            self._robots += 1
            self._senses.grow()
        self._look()
        self._senses.add_robot(0, robot, self._state.poses[robot])
        return robot

    def remove_robot(self, world: int, robot: int) -> None:
        """Take a robot out; its scans become ``+inf`` and its pose ``NaN``.

        Raises:
            TriformError: If there is no such world or robot.
        """
        self._check_world(world)
        self._server.remove(robot)
        self._look()
        self._senses.remove_robot(0, robot)

    def _advance(self, targets: FloatArray, stop: float, turn_ends: bool) -> None:
        """Drive until ``stop`` [s], which lies within one turn of the LiDAR."""
        rolling = self.profile.lidar.rolling
        looks = max(1, math.ceil((stop - self.time) / self.profile.time_step - 1e-6)) if rolling else 1
        period = (stop - self.time) / looks
        bounds = self._senses.rays_due(self.time, looks, period, turn_ends)
        for look in range(looks):
            steps = round((self.time + (look + 1) * period - self._state.time) / self._server.time_step)
            self._take(self._server.step(targets, max(0, steps), scan=rolling or turn_ends))
            if rolling:
                due = slice(bounds[look], bounds[look + 1])
                self._senses.ranges[:, :, due] = self._ranges()[:, :, due]

    def _ranges(self) -> FloatArray:
        """What was measured when Gazebo last looked [m], shape (1, N, R)."""
        assert self._state.ranges is not None
        return self._state.ranges[None, : self._robots].copy()

    def _look(self) -> None:
        """See what is there without letting time pass."""
        self._take(self._server.step(np.zeros((len(self._state.active), 3)), 0, scan=False))

    def _take(self, state: State) -> None:
        self._state = state
        self.min_distance = np.minimum(self.min_distance, state.min_distance)
        self.collided = self.collided | state.touched
        self.hit_arena = self.hit_arena | state.touched_arena

    def _check_world(self, world: int) -> None:
        if world != 0:
            raise TriformError(f"there is no world {world}; Gazebo has one, number 0")
