"""The built-in world: many independent teams at once, one time for all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from triform.simulation.arena import Arena, get_arena
from triform.simulation.kinematics import drive_limits, integrate, limit_twists
from triform.simulation.lidar import MOVING_RAYS_PER_THREAD, HitArray, cast_scans, scan_rays
from triform.simulation.profiles import Profile
from triform.simulation.ray_kernels import Scene
from triform.simulation.sensors import SensorSuite, padded
from triform.simulation.shipped import get_profile
from triform.simulation.spawning import sample_starts, world_seeds
from triform.simulation.world_kernels import Contacts, LidarTurn, Motion, advance_worlds, record_contacts
from triform.threads import in_parts
from triform.types import (
    SENSING_RANGE,
    BoolArray,
    ConfigurationError,
    FloatArray,
    PrivilegedView,
    RangeArray,
    TriformError,
    as_array,
    converted,
    require,
)

#: Robots whose contacts keep a thread busy for a few milliseconds.
RECORDS_PER_THREAD = 20_000


class World:
    """``B`` worlds of up to ``N`` robots: a ``Team[PrivilegedView]``.

    Robots measure while everybody moves, and a view shows what ``SensorSuite`` says, from a first scan at time 0 on.

    Physical contact is not simulated: robots pass through each other, walls and pillars, and overlaps are
    recorded.

    Every world draws from generators of its own, one for each robot. A world's run is the same to the bit whatever
    the number of threads and whatever other worlds are in the batch.
    """

    def __init__(
        self,
        poses: ArrayLike,
        profile: Profile,
        arena: Arena | None = None,
        seeds: Sequence[int | np.random.SeedSequence] | None = None,
        active: ArrayLike | None = None,
        from_lidar: bool = False,
    ) -> None:
        """Place the robots at rest.

        Args:
            poses: Poses in the world frame, shape (B, N, 3) [m, m, rad].
            profile: Kind of all robots.
            arena: Walls and pillars; by default none.
            seeds: One seed for every world; may be left out if the profile has no random errors.
            active: Which robots exist, shape (B, N); by default all.
            from_lidar: Whether views show scans as the LiDARs measure them, each from where it is mounted, as the
                driver of a real one does; controllers want them from the base's centre.

        Raises:
            ConfigurationError: If shapes do not fit, an active robot's pose is not finite, or seeds are missing.
        """
        converted("profile", profile, Profile)
        converted("arena", arena, Arena | None)
        placed = np.array(as_array("poses", poses))
        require(
            placed.ndim == 3 and placed.shape[2] == 3 and placed.size > 0,
            f"poses of shape {placed.shape} given; (worlds, robots, 3) is needed, with at least one of each",
        )
        worlds, robots = placed.shape[:2]
        present = np.ones((worlds, robots), dtype=np.bool_) if active is None else active
        self._active = np.array(as_array("flags of active robots", present, np.bool_))
        require(
            self._active.shape == (worlds, robots),
            f"active of shape {self._active.shape} given; {(worlds, robots)} is needed",
        )
        bad = np.argwhere(self._active & ~np.isfinite(placed).all(axis=2))
        if len(bad):
            b, i = bad[0]
            raise ConfigurationError(f"the pose of robot {i} in world {b} is {placed[b, i]}; it must be finite")
        placed[~self._active] = np.nan
        self._profile = profile
        self._arena = Arena.open() if arena is None else arena
        # A pose moved by nothing has its heading wrapped.
        self._poses = integrate(placed, np.zeros_like(placed), 0.0)
        self._velocities = np.zeros_like(placed)
        self._min_distance = np.full(worlds, np.inf)
        self._collided = np.zeros(worlds, dtype=np.bool_)
        self._hit_arena = np.zeros(worlds, dtype=np.bool_)
        self._time = 0.0
        self._senses = SensorSuite(profile, self._poses, self._active, seeds, self._arena, from_lidar)
        self._record()
        if not profile.lidar.rolling:
            ranges, hits = self._snapshot()
            self._senses.finish(ranges, self._poses, self._active, hits)

    @property
    def profile(self) -> Profile:
        """Kind of all robots."""
        return self._profile

    @property
    def arena(self) -> Arena:
        """Walls and pillars."""
        return self._arena

    @property
    def control_period(self) -> float:
        """Time between two commands [s]."""
        return self._profile.control_period

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self._time

    @property
    def poses(self) -> FloatArray:
        """True poses in the world frame, shape (B, N, 3) [m, m, rad]; ``NaN`` where not active."""
        return self._poses.copy()

    @property
    def velocities(self) -> FloatArray:
        """Actual body twists, shape (B, N, 3) [m/s, m/s, rad/s]; zero where not active."""
        return self._velocities.copy()

    @property
    def active(self) -> BoolArray:
        """Which robots exist, shape (B, N)."""
        return self._active.copy()

    @property
    def min_distance(self) -> FloatArray:
        """Smallest distance between two centres at any integration step so far, shape (B,) [m]."""
        return self._min_distance.copy()

    @property
    def collided(self) -> BoolArray:
        """Whether two footprints have overlapped at any integration step so far, shape (B,)."""
        return self._collided.copy()

    @property
    def hit_arena(self) -> BoolArray:
        """Whether a footprint has overlapped a wall or pillar at any integration step so far, shape (B,)."""
        return self._hit_arena.copy()

    def observe(self) -> PrivilegedView:
        """Return the newest scans whose latency has passed, and everybody's true pose."""
        return self._senses.view(self._time, self._poses, self._velocities, self._active)

    def apply(self, commands: FloatArray, duration: float) -> None:
        """Hold body twists for a while.

        Args:
            commands: Body twists, shape (B, N, 3) [m/s, m/s, rad/s]; those of inactive robots are not used.
            duration: How long [s]. It is cut at the ends of LiDAR turns, and each part is integrated in equal steps
                of at most the profile's ``time_step``.

        Raises:
            TriformError: If the shape does not fit, a command is not finite, or the duration is not positive.
        """
        duration = converted("duration", duration, float)
        targets = limit_twists(self._checked(commands), self._profile.drive)
        end = self._time + duration
        for stop, turn_ends in self._senses.stretches(self._time, duration):
            self._advance(targets, stop - self._time, turn_ends)
            self._time = stop
            if turn_ends:
                ranges, hits = (None, None) if self._profile.lidar.rolling else self._snapshot()
                self._senses.end_turn(ranges, self._poses, self._active, hits)
        self._time = end

    def add_robot(self, world: int, pose: ArrayLike) -> int:
        """Add a robot at rest to one world; the axis N grows if no place is free.

        Others see it from their next ray on. Its own first scan is the next one to be finished; of a rolling turn
        that has begun, the rays already past are ``NaN``.

        Args:
            world: Index of the world.
            pose: Pose in the world frame, shape (3,) [m, m, rad].

        Returns:
            Index of the new robot along axis N.

        Raises:
            TriformError: If there is no such world or the pose is not three finite numbers.
        """
        self._check_world(world)
        placed = as_array("numbers of a pose", pose)
        if placed.shape != (3,) or not np.isfinite(placed).all():
            raise TriformError(f"a robot cannot be placed at {placed}; a pose is three finite numbers")
        free = np.flatnonzero(~self._active[world])
        if len(free) == 0:
            self._grow()
        robot = int(free[0]) if len(free) else self._active.shape[1] - 1
        self._active[world, robot] = True
        self._poses[world, robot] = integrate(placed, np.zeros(3), 0.0)
        self._velocities[world, robot] = 0.0
        self._senses.add_robot(world, robot, self._poses[world, robot])
        self._record()
        return robot

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
        self._poses[world, robot] = np.nan
        self._velocities[world, robot] = 0.0
        self._senses.remove_robot(world, robot)

    def _checked(self, commands: FloatArray) -> FloatArray:
        values = as_array("commands", commands)
        if values.shape != self._poses.shape:
            raise TriformError(f"commands of shape {values.shape} given; {self._poses.shape} is needed")
        finite = np.isfinite(values).all(axis=2) | ~self._active
        if not finite.all():
            b, i = np.argwhere(~finite)[0]
            raise TriformError(f"the command {values[b, i]} of robot {i} in world {b} is not finite")
        return values

    def _check_world(self, world: int) -> None:
        if not 0 <= converted("world", world, int) < len(self._active):
            raise TriformError(f"there is no world {world}; worlds are 0 to {len(self._active) - 1}")

    @property
    def _scene(self) -> Scene:
        return Scene(self._profile.footprint.body, self._arena.walls, self._arena.pillars)

    @property
    def _contacts(self) -> Contacts:
        return Contacts(self._min_distance, self._collided, self._hit_arena)

    def _record(self) -> None:
        record = partial(record_contacts, self._poses, self._active, self._scene, self._contacts)
        in_parts(record, len(self._active), self._active.size, RECORDS_PER_THREAD)

    def _advance(self, targets: FloatArray, duration: float, turn_ends: bool) -> None:
        """Move by ``duration`` [s], which lies within one turn of the LiDAR."""
        lidar = self._profile.lidar
        substeps = max(1, math.ceil(duration / self._profile.time_step - 1e-6))
        step = duration / substeps
        elapsed = self._senses.elapsed(self._time)
        bounds = self._senses.rays_due(self._time, substeps, step, turn_ends)
        # Driving a robot for a step takes about as long as casting two rays.
        rays = self._active.size * (2 * substeps + int(bounds[-1] - bounds[0]))
        motion = Motion(self._poses, self._velocities, targets, self._active, drive_limits(self._profile.drive), step)
        ray_period = lidar.period / lidar.scan.rays
        rays_of_turn = scan_rays(self._profile.from_lidar, self._profile.mounting.x, self._profile.mounting.y)
        senses = self._senses
        turn = LidarTurn(bounds, elapsed, ray_period, rays_of_turn, senses.offsets, senses.ranges, senses.hits)
        advance = partial(advance_worlds, motion, self._scene, self._contacts, turn)
        in_parts(advance, len(self._active), rays, MOVING_RAYS_PER_THREAD)

    def _snapshot(self) -> tuple[RangeArray, HitArray | None]:
        """All rays at this moment, without range noise, and what they hit if intensities are asked for."""
        profile, mounting = self._profile, self._profile.mounting
        scene = (profile.footprint, self._arena, profile.from_lidar, self._senses.draw_offsets(self._active))
        hits = self._senses.no_hits(self._active)
        eye = (mounting.x, mounting.y)
        return cast_scans(self._poses, self._active, *scene, np.float32, eye, hits), hits

    def _grow(self) -> None:
        """Append one place to axis N of everything."""
        self._active = np.pad(self._active, ((0, 0), (0, 1)))
        self._poses = padded(self._poses, np.nan)
        self._velocities = padded(self._velocities, 0.0)
        self._senses.grow()


def make_world(
    robots: int = 9,
    seed: int = 7,
    runs: int = 1,
    profile: str = "ideal",
    arena: str = "open",
    distance: float = 1.0,
) -> World:
    """Return worlds at their random starts: runs 0, 1, ... of an evaluation with the same settings.

    Args:
        robots: Robots of each team, N.
        seed: Seed of starts and noise.
        runs: Number of worlds, B.
        profile: Robot profile: a name or a TOML file.
        arena: Arena: a name or a TOML file.
        distance: Prescribed neighbour distance d* [m]; a robot sees 2 d* far.

    Raises:
        ConfigurationError: A name is unknown or a number not allowed.
    """
    runs, distance = converted("runs", runs, int), converted("distance", distance, float)
    require(runs >= 1, f"runs is {runs}; at least 1 is needed")
    require(0 < distance < np.inf, f"distance is {distance} m; it must be positive and finite")
    poses = sample_starts(robots, runs, seed, distance=distance)
    seeds = world_seeds(robots, seed, range(runs))
    return World(poses, get_profile(profile).seeing(SENSING_RANGE * distance), get_arena(arena), seeds)
