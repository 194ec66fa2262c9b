"""Robots in MuJoCo as teams that any controller drives, like those of the built-in world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import ArrayLike

from triform.simulation.arena import Arena
from triform.simulation.kinematics import limit_twists
from triform.simulation.lidar import HitArray
from triform.simulation.profiles import Profile
from triform.simulation.sensors import SensorSuite
from triform.simulators.chassis import BASES, Base, braked, check_base
from triform.simulators.mujoco.lidar import RayCaster
from triform.simulators.mujoco.model import MOTIONS, write_model, write_sight
from triform.simulators.mujoco.picture import draw
from triform.threads import usable_threads
from triform.types import (
    BoolArray,
    FloatArray,
    MapArray,
    PrivilegedView,
    RangeArray,
    TriformError,
    as_array,
    converted,
    require,
)

#: Robots that do not exist stand this far away [m], and as far apart as a robot needs.
_FAR, _APART = 1e6, 10.0
#: What describes a robot in motion, apart from its place among the others.
_STATE = ("qpos", "qvel", "qacc_warmstart")


class MujocoError(TriformError):
    """MuJoCo's physics has become unstable."""


class MujocoTeam:
    """B worlds of N robots in MuJoCo: a ``SimulatedTeam`` with the interface of ``triform.simulation.World``.

    Bodies, contacts and motion are MuJoCo's, and so are exact ranges; turns, errors, latency, odometry and exploration
    noise come from ``SensorSuite``, the same as in the built-in world. Everything happens at the end of a step of the
    physics: a moment between two steps is that of the nearest one, and a rolling LiDAR measures what has fallen due
    once in every ``time_step`` of the profile. Robots that touch are recorded as a collision, because solid bodies
    cannot overlap. A world's run is the same to the bit whatever the number of threads and whatever other worlds are
    in the batch.

    Attributes:
        profile: Kind of all robots.
        arena: Walls and pillars.
        control_period: Time between two commands [s].
        time: Time since the start [s].
        min_distance: Smallest distance between two centres at any step so far, shape (B,) [m].
        collided: Whether two robots have touched at the beginning of any step so far, shape (B,).
        hit_arena: Whether a robot has touched a wall or pillar at the beginning of any step so far, shape (B,).
    """

    def __init__(
        self,
        poses: ArrayLike,
        profile: Profile,
        arena: Arena | None = None,
        seeds: Sequence[int | np.random.SeedSequence] | None = None,
        base: Base = "planar",
    ) -> None:
        """Place the robots at rest.

        Args:
            poses: Poses in the world frame, shape (B, N, 3) [m, m, rad].
            profile: Kind of all robots.
            arena: Walls and pillars; by default none.
            seeds: One seed for every world; may be left out if the profile has no random errors.
            base: How the robots move: by a force in the plane, on four mecanum wheels, or on two driven wheels and
                casters.

        Raises:
            ConfigurationError: If the shape does not fit, a pose is not finite, wheels do not fit under the footprint,
                or seeds are missing.
        """
        converted("profile", profile, Profile)
        converted("arena", arena, Arena | None)
        placed = as_array("poses", poses)
        require(
            placed.ndim == 3 and placed.shape[2] == 3 and placed.size > 0 and bool(np.isfinite(placed).all()),
            f"poses of shape {placed.shape} given; finite ones of shape (worlds, robots, 3) are needed",
        )
        require(base in BASES, f"base is {base!r}; allowed are {', '.join(BASES)}")
        check_base(base, profile)
        worlds, robots = placed.shape[:2]
        self.profile, self.arena, self.control_period = profile, arena or Arena.open(), profile.control_period
        self.newcomer = profile
        self.time = 0.0
        self.min_distance: FloatArray = np.full(worlds, np.inf)
        self.collided: BoolArray = np.zeros(worlds, np.bool_)
        self.hit_arena: BoolArray = np.zeros(worlds, np.bool_)
        self._base: Base = base
        self._braked = replace(profile, drive=braked(profile.drive))
        self._active = np.ones((worlds, robots), np.bool_)
        self._steps = 0
        self._build()
        for b, i in np.ndindex(worlds, robots):
            self._motion.place(b, i, placed[b, i])
        self._approach()
        self._senses = SensorSuite(self._braked, self.poses, self._active, seeds, self.arena)
        if not profile.lidar.rolling:
            ranges, hits = self._snapshot()
            self._senses.finish(ranges, self.poses, self._active, hits)

    @property
    def poses(self) -> FloatArray:
        """True poses in the world frame, shape (B, N, 3) [m, m, rad]; ``NaN`` where not active."""
        return np.where(self._active[..., None], self._motion.poses, np.nan)

    @property
    def velocities(self) -> FloatArray:
        """Actual body twists, shape (B, N, 3) [m/s, m/s, rad/s]; zero where not active."""
        return np.where(self._active[..., None], self._motion.twists, 0.0)

    @property
    def active(self) -> BoolArray:
        """Which robots exist, shape (B, N)."""
        return self._active.copy()

    def observe(self) -> PrivilegedView:
        """Return the newest scans whose latency has passed, and everybody's true pose."""
        return self._senses.view(self.time, self.poses, self.velocities, self._active)

    def apply(self, commands: FloatArray, duration: float) -> None:
        """Hold body twists for a while.

        Args:
            commands: Body twists, shape (B, N, 3) [m/s, m/s, rad/s]; those of inactive robots are not used.
            duration: How long [s].

        Raises:
            MujocoError: If the physics becomes unstable.
            TriformError: If the shape does not fit, a command is not finite, or the duration is not positive.
        """
        targets = limit_twists(self._checked(commands), self.profile.drive)
        duration = converted("duration", duration, float)
        end = self.time + duration
        for stop, turn_ends in self._senses.stretches(self.time, duration):
            self._advance(targets, stop, turn_ends)
            self.time = stop
            if turn_ends:
                ranges, hits = (None, None) if self.profile.lidar.rolling else self._snapshot()
                self._senses.end_turn(ranges, self.poses, self._active, hits)
        self.time = end

    def add_robot(self, world: int, pose: ArrayLike) -> int:
        """Add a robot at rest to one world and return its index along axis N, which grows if no place is free.

        Raises:
            TriformError: If there is no such world or the pose is not three finite numbers.
        """
        self._check_world(world)
        placed = _checked_pose(pose)
        if self._active[world].all():
            self._grow()
        robot = int(np.flatnonzero(~self._active[world])[0])
        self._place(world, robot, placed)
        return robot

    def move_robot(self, world: int, robot: int, pose: ArrayLike) -> None:
        """Put a robot elsewhere, at rest, as if it left and joined there with its own place along axis N.

        Raises:
            TriformError: If there is no such world or robot, or the pose is not three finite numbers.
        """
        placed = _checked_pose(pose)
        self.remove_robot(world, robot)
        self._place(world, robot, placed)

    def remove_robot(self, world: int, robot: int) -> None:
        """Take a robot out of one world; its scans become ``+inf`` and its pose ``NaN``.

        Raises:
            TriformError: If there is no such world or robot.
        """
        self._check_world(world)
        if not 0 <= converted("robot", robot, int) < self._active.shape[1] or not self._active[world, robot]:
            present = np.flatnonzero(self._active[world]).tolist()
            raise TriformError(f"world {world} has no robot {robot}; its robots are {present}")
        self._active[world, robot] = False
        self._park(world, robot)
        self._senses.remove_robot(world, robot)

    def _place(self, world: int, robot: int, pose: FloatArray) -> None:
        """Let a robot begin at ``pose``, shape (3,), at rest."""
        self._active[world, robot] = True
        self._motion.place(world, robot, pose)
        self._approach()
        self._senses.add_robot(world, robot, self.poses[world, robot])

    def picture(self, world: int = 0, width: int = 960, height: int = 720) -> MapArray:
        """Draw one world from above with MuJoCo's renderer: colours of shape (height, width, 3).

        Raises:
            TriformError: There is no such world, or no OpenGL that the renderer can use.
        """
        self._check_world(world)
        places = self.poses[world, self._active[world], :2]
        return draw(self._batch.model, self._batch.qpos[world], places, width, height)

    def _build(self) -> None:
        """Make the simulations, all robots parked."""
        worlds, robots = self._active.shape
        model = mujoco.MjModel.from_xml_string(write_model(self._braked, self.arena, robots, self._base))
        self._batch = Batch(model, worlds, min(worlds, usable_threads()))
        self._motion = MOTIONS[self._base](self._batch, robots, self._braked)
        sight = mujoco.MjModel.from_xml_string(write_sight(self.profile.footprint, self.arena, robots))
        mounting = self.profile.mounting
        self._rays = RayCaster(sight, self.profile.from_lidar, (mounting.x, mounting.y))
        self._found = self._batch.bind("sensordata").reshape(worlds, robots, 2)
        for b, i in np.ndindex(worlds, robots):
            self._park(b, i)

    def _park(self, world: int, robot: int) -> None:
        """Put a robot where it meets nothing."""
        self._motion.place(world, robot, np.array([_FAR + _APART * robot, _FAR, 0.0]))

    def _grow(self) -> None:
        """Append one place to axis N of everything."""
        old, (worlds, robots) = self._batch, self._active.shape
        self._active = np.pad(self._active, ((0, 0), (0, 1)))
        self._build()
        for name in _STATE:
            before, now = getattr(old, name), getattr(self._batch, name)
            now.reshape(worlds, robots + 1, -1)[:, :robots] = before.reshape(worlds, robots, -1)
        self._senses.grow()

    def _advance(self, targets: FloatArray, stop: float, turn_ends: bool) -> None:
        """Drive until ``stop`` [s], which lies within one turn of the LiDAR."""
        rolling = self.profile.lidar.rolling
        looks = max(1, math.ceil((stop - self.time) / self.profile.time_step - 1e-6)) if rolling else 1
        period = (stop - self.time) / looks
        bounds = self._senses.rays_due(self.time, looks, period, turn_ends)
        for look in range(looks):
            self._step_until(self.time + (look + 1) * period, targets)
            if rolling:
                due = slice(int(bounds[look]), int(bounds[look + 1]))
                senses, hits = self._senses, self._senses.hits if self._senses.is_bright else None
                self._rays.cast_into(senses.ranges, self._motion.frames, self._active, due, self._offsets, hits)

    def _step_until(self, time: float, targets: FloatArray) -> None:
        """Take the steps of the physics up to the one nearest to ``time`` [s]."""
        while self._steps < round(time / self._motion.time_step):
            self._motion.drive(targets)
            self._batch.step()
            self._steps += 1
            self._approach()
            self.collided |= (self._found[..., 0] > self._found[..., 1]).any(axis=1)
            self.hit_arena |= (self._found[..., 1] > 0).any(axis=1)
        # How often MuJoCo warned of what: after most warnings it starts anew from nowhere.
        warned = self._batch.warning[..., 1].any(axis=1)
        if warned.any():
            raise MujocoError(
                f"the physics of world {int(np.argmax(warned))} became unstable within {time:.3f} s after the start"
            )

    @property
    def _offsets(self) -> FloatArray | None:
        """Errors of the angles of a rolling turn, shape (B, N, R) [rad]; ``None`` without any."""
        return self._senses.offsets if self._senses.offsets.shape[2] else None

    def _snapshot(self) -> tuple[RangeArray, HitArray | None]:
        """All rays at this moment, without errors of range, and what they hit if asked for, shapes (B, N, R)."""
        ranges = np.full((*self._active.shape, self.profile.lidar.scan.rays), np.inf, np.float32)
        offsets, hits = self._senses.draw_offsets(self._active), self._senses.no_hits(self._active)
        self._rays.cast_into(ranges, self._motion.frames, self._active, offsets=offsets, hits=hits)
        return ranges, hits

    def _approach(self) -> None:
        """Fold the distances between robots into the smallest."""
        places = np.where(self._active[..., None], self._motion.poses[..., :2], np.nan)
        apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
        np.einsum("bii->bi", apart)[:] = np.nan
        self.min_distance = np.fmin(self.min_distance, np.fmin.reduce(apart, axis=(1, 2)))

    def _checked(self, commands: FloatArray) -> FloatArray:
        values = np.array(as_array("commands", commands))
        shape = (*self._active.shape, 3)
        if values.shape != shape:
            raise TriformError(f"commands of shape {values.shape} given; {shape} is needed")
        values[~self._active] = 0.0
        if not np.isfinite(values).all():
            b, i = np.argwhere(~np.isfinite(values).all(axis=2))[0]
            raise TriformError(f"the command {values[b, i]} of robot {i} in world {b} is not finite")
        return values

    def _check_world(self, world: int) -> None:
        if not 0 <= converted("world", world, int) < len(self._active):
            raise TriformError(f"there is no world {world}; worlds are 0 to {len(self._active) - 1}")


def _checked_pose(pose: ArrayLike) -> FloatArray:
    placed = as_array("numbers of a pose", pose)
    if placed.shape != (3,) or not np.isfinite(placed).all():
        raise TriformError(f"a robot cannot be placed at {placed}; a pose is three finite numbers")
    return placed
