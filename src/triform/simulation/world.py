"""The built-in world: many independent teams at once, one time for all."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from triform.simulation._world_kernels import advance_worlds, record_contacts
from triform.simulation.arena import Arena
from triform.simulation.kinematics import drive_limits, integrate, limit_twists
from triform.simulation.lidar import MOVING_RAYS_PER_THREAD, angle_offsets, apply_noise, cast_scans, scan_rays
from triform.simulation.odometry import halfway, relative_poses
from triform.simulation.profiles import Profile
from triform.simulation.pushes import push_keys, random_pushes
from triform.threads import in_parts
from triform.types import (
    BoolArray,
    ConfigurationError,
    FloatArray,
    IntArray,
    PrivilegedView,
    RangeArray,
    Scan,
    TriformError,
    require,
)

Floating = TypeVar("Floating", bound=np.floating[Any])

#: Robots whose contacts keep a thread busy for a few milliseconds.
RECORDS_PER_THREAD = 20_000
#: Moments closer than this are the same moment [s].
_SAME_TIME = 1e-9
#: Speed of a base from which random pushes have their full size [m/s]; those of a slower one are smaller in proportion,
#: because what is cut to one speed, push and command alike, would be hardly anything but push.
_FULL_PUSH_SPEED = 0.5


class World:
    """``B`` worlds of up to ``N`` robots: a ``Team[PrivilegedView]``.

    A LiDAR turn lasts one period. With a rolling LiDAR ray k is measured at the share k / R of the turn while
    everybody moves, and the scan is finished when the turn ends; otherwise all rays are measured at the end of
    the turn, and a first scan at time 0. A finished scan can be observed after the profile's latency; until
    the first one can, nothing is seen (``+inf`` throughout).

    Physical contact is not simulated: robots pass through each other, walls and pillars, and overlaps are
    recorded.

    A view also carries each robot's random push and its odometry, which is exact. The moment that a rolling scan shows
    is the middle of its turn.

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
    ) -> None:
        """Place the robots at rest.

        Args:
            poses: Poses in the world frame, shape (B, N, 3) [m, m, rad].
            profile: Kind of all robots.
            arena: Walls and pillars; by default none.
            seeds: One seed for every world; may be left out if the profile has no random errors.
            active: Which robots exist, shape (B, N); by default all.

        Raises:
            ConfigurationError: If shapes do not fit, an active robot's pose is not finite, or seeds are missing.
        """
        placed = np.array(poses, dtype=np.float64, order="C")
        require(
            placed.ndim == 3 and placed.shape[2] == 3 and placed.size > 0,
            f"poses of shape {placed.shape} given; (worlds, robots, 3) is needed, with at least one of each",
        )
        worlds, robots = placed.shape[:2]
        self._active = np.ones((worlds, robots), dtype=np.bool_) if active is None else np.array(active)
        require(
            self._active.shape == (worlds, robots) and self._active.dtype == np.bool_,
            f"active of shape {self._active.shape} and type {self._active.dtype} given; "
            f"bool of shape {(worlds, robots)} is needed",
        )
        bad = np.argwhere(self._active & ~np.isfinite(placed).all(axis=2))
        if len(bad):
            b, i = bad[0]
            raise ConfigurationError(f"the pose of robot {i} in world {b} is {placed[b, i]}; it must be finite")
        placed[~self._active] = np.nan
        lidar = profile.lidar
        self._noisy = bool(lidar.noise) or lidar.angle_noise > 0 or lidar.dropout > 0
        self._seeds = _sequences(seeds, worlds, self._noisy)
        self._push_keys = push_keys(self._seeds, worlds)
        fastest = min(profile.drive.max_speed, profile.drive.max_axis_speed)
        self._push_size = min(1.0, fastest / _FULL_PUSH_SPEED)
        self._rngs: dict[tuple[int, int], np.random.Generator] = {}
        self._profile = profile
        self._arena = Arena.open() if arena is None else arena
        # A pose moved by nothing has its heading wrapped.
        self._poses = integrate(placed, np.zeros_like(placed), 0.0)
        self._velocities = np.zeros_like(placed)
        self._min_distance = np.full(worlds, np.inf)
        self._collided = np.zeros(worlds, dtype=np.bool_)
        self._hit_arena = np.zeros(worlds, dtype=np.bool_)
        self._time = 0.0
        self._turn = 0
        self._next_ray = 0
        self._blank_turn()
        # Until there is a scan, one number stands for all rays.
        self._newest: RangeArray = np.broadcast_to(np.float32(np.inf), (worlds, robots, lidar.scan.rays))
        self._shown: FloatArray = self._poses.copy()
        self._turn_start: FloatArray = self._shown
        self._finished: deque[tuple[float, RangeArray, FloatArray]] = deque()
        self._record()
        if not lidar.rolling:
            self._finish_scan(self._snapshot())

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
        ready = self._time - self._profile.latency + _SAME_TIME
        while self._finished and self._finished[0][0] <= ready:
            _, self._newest, self._shown = self._finished.popleft()
        return PrivilegedView(
            scans=Scan(self._newest, self._profile.lidar.scan),
            active=self.active,
            time=self._time,
            poses=self.poses,
            push=self._push_size * random_pushes(self._push_keys, self._active.shape[1], self._time),
            moved=relative_poses(self._poses, self._shown, self._active) if self._profile.odometry else None,
        )

    def apply(self, commands: FloatArray, duration: float) -> None:
        """Hold body twists for a while.

        Args:
            commands: Body twists, shape (B, N, 3) [m/s, m/s, rad/s]; those of inactive robots are not used.
            duration: How long [s]. It is cut at the ends of LiDAR turns, and each part is integrated in equal steps
                of at most the profile's ``time_step``.

        Raises:
            TriformError: If the shape does not fit, a command is not finite, or the duration is not positive.
        """
        targets = limit_twists(self._checked(commands), self._profile.drive)
        if not 0 < duration < math.inf:
            raise TriformError(f"commands cannot be held for {duration} s; the time must be positive and finite")
        end = self._time + duration
        while end - self._time > _SAME_TIME:
            turn_end = (self._turn + 1) * self._profile.lidar.period
            stop = turn_end if turn_end < end - _SAME_TIME else end
            turn_ends = turn_end <= stop + _SAME_TIME
            self._advance(targets, stop - self._time, turn_ends)
            self._time = stop
            if turn_ends:
                self._end_turn()
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
        placed = np.array(pose, dtype=np.float64)
        if placed.shape != (3,) or not np.isfinite(placed).all():
            raise TriformError(f"a robot cannot be placed at {placed}; a pose is three finite numbers")
        free = np.flatnonzero(~self._active[world])
        if len(free) == 0:
            self._grow()
        robot = int(free[0]) if len(free) else self._active.shape[1] - 1
        self._active[world, robot] = True
        self._poses[world, robot] = integrate(placed, np.zeros(3), 0.0)
        self._velocities[world, robot] = 0.0
        for shown in (self._shown, self._turn_start, *(poses for _, _, poses in self._finished)):
            shown[world, robot] = self._poses[world, robot]
        self._turn_ranges[world, robot, : self._next_ray] = np.nan
        self._turn_ranges[world, robot, self._next_ray :] = np.inf
        if self._profile.lidar.rolling and self._noisy:
            self._offsets[world, robot] = angle_offsets(
                self._offsets.shape[2:], self._profile.lidar, self._rng(world, robot)
            )
        self._record()
        return robot

    def remove_robot(self, world: int, robot: int) -> None:
        """Take a robot out of one world; its scans become ``+inf`` and its pose ``NaN``.

        Raises:
            TriformError: If there is no such world or robot.
        """
        self._check_world(world)
        if not 0 <= robot < self._active.shape[1] or not self._active[world, robot]:
            present = np.flatnonzero(self._active[world]).tolist()
            raise TriformError(f"world {world} has no robot {robot}; its robots are {present}")
        self._active[world, robot] = False
        self._poses[world, robot] = np.nan
        self._velocities[world, robot] = 0.0
        self._turn_ranges[world, robot] = np.inf
        # Views handed out earlier share these arrays and must not change.
        self._newest = self._newest.copy()
        self._newest[world, robot] = np.inf
        for _, ranges, _ in self._finished:
            ranges[world, robot] = np.inf

    def _checked(self, commands: FloatArray) -> FloatArray:
        values = np.asarray(commands, dtype=np.float64)
        if values.shape != self._poses.shape:
            raise TriformError(f"commands of shape {values.shape} given; {self._poses.shape} is needed")
        finite = np.isfinite(values).all(axis=2) | ~self._active
        if not finite.all():
            b, i = np.argwhere(~finite)[0]
            raise TriformError(f"the command {values[b, i]} of robot {i} in world {b} is not finite")
        return values

    def _check_world(self, world: int) -> None:
        if not 0 <= world < len(self._active):
            raise TriformError(f"there is no world {world}; worlds are 0 to {len(self._active) - 1}")

    def _rng(self, world: int, robot: int) -> np.random.Generator:
        """Generator of one robot: a function of its world's seed and its index alone."""
        if (world, robot) not in self._rngs:
            seed = self._seeds[world]
            sequence = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, robot))
            self._rngs[world, robot] = np.random.default_rng(sequence)
        return self._rngs[world, robot]

    def _record(self) -> None:
        scene = (self._profile.footprint.body, self._arena.walls, self._arena.pillars)
        records = (self._min_distance, self._collided, self._hit_arena)
        in_parts(
            lambda first, last: record_contacts(self._poses, self._active, *scene, *records, first, last),
            len(self._active), self._active.size, RECORDS_PER_THREAD,
        )  # fmt: skip

    def _ray_bounds(self, substeps: int, step: float, elapsed: float, turn_ends: bool) -> IntArray:
        """Rays of the running turn that have fallen due before each of ``substeps`` and after the last."""
        lidar = self._profile.lidar
        if not lidar.rolling:
            return np.zeros(substeps + 1, dtype=np.int64)
        ends = elapsed + step * np.arange(substeps + 1)
        due = np.ceil(ends * (lidar.scan.rays / lidar.period) - 1e-6).astype(np.int64)
        bounds = np.clip(due, self._next_ray, lidar.scan.rays)
        bounds[0] = self._next_ray
        if turn_ends:
            bounds[-1] = lidar.scan.rays
        return cast(IntArray, bounds)

    def _advance(self, targets: FloatArray, duration: float, turn_ends: bool) -> None:
        """Move by ``duration`` [s], which lies within one turn of the LiDAR."""
        lidar = self._profile.lidar
        substeps = max(1, math.ceil(duration / self._profile.time_step - 1e-6))
        step = duration / substeps
        elapsed = self._time - self._turn * lidar.period
        bounds = self._ray_bounds(substeps, step, elapsed, turn_ends)
        # Driving a robot for a step takes about as long as casting two rays.
        rays = self._active.size * (2 * substeps + int(bounds[-1] - bounds[0]))
        motion = (self._poses, self._velocities, targets, self._active, drive_limits(self._profile.drive), step)
        scene = (self._profile.footprint.body, self._arena.walls, self._arena.pillars)
        records = (self._min_distance, self._collided, self._hit_arena)
        timing = (bounds, elapsed, lidar.period / lidar.scan.rays)
        turn = (scan_rays(lidar.scan)[:3], self._offsets, self._turn_ranges)
        in_parts(
            lambda first, last: advance_worlds(*motion, *scene, *records, *timing, *turn, first, last),
            len(self._active), rays, MOVING_RAYS_PER_THREAD,
        )  # fmt: skip
        self._next_ray = int(bounds[-1])

    def _end_turn(self) -> None:
        self._turn += 1
        self._finish_scan(self._turn_ranges if self._profile.lidar.rolling else self._snapshot())
        self._next_ray = 0
        self._blank_turn()

    def _blank_turn(self) -> None:
        """Begin a turn in which nothing has been measured."""
        lidar = self._profile.lidar
        self._turn_start = self._poses.copy()
        # A LiDAR that measures all rays at once keeps no turn.
        shape = (*self._active.shape, lidar.scan.rays if lidar.rolling else 0)
        self._turn_ranges = np.full(shape, np.inf, np.float32)
        self._offsets = self._draw_offsets(shape) if lidar.angle_noise > 0 else np.empty((*shape[:2], 0))

    def _draw_offsets(self, shape: tuple[int, ...]) -> FloatArray:
        offsets = np.zeros(shape)
        if shape[2] > 0:
            for b, i in np.argwhere(self._active):
                offsets[b, i] = angle_offsets(shape[2:], self._profile.lidar, self._rng(b, i))
        return offsets

    def _snapshot(self) -> RangeArray:
        """All rays at this moment, without range noise."""
        lidar = self._profile.lidar
        offsets = None
        if lidar.angle_noise > 0:
            offsets = self._draw_offsets((*self._active.shape, lidar.scan.rays))
        scene = (self._profile.footprint, self._arena, lidar.scan)
        return cast_scans(self._poses, self._active, *scene, offsets, np.float32)

    def _finish_scan(self, ranges: RangeArray) -> None:
        if self._noisy:
            for b, i in np.argwhere(self._active):
                ranges[b, i] = apply_noise(ranges[b, i], self._profile.lidar, self._rng(b, i))
        rolling = self._profile.lidar.rolling
        shown = halfway(self._turn_start, self._poses, self._active) if rolling else self._poses.copy()
        self._finished.append((self._turn * self._profile.lidar.period, ranges, shown))

    def _grow(self) -> None:
        """Append one place to axis N of everything."""

        def padded(values: NDArray[Floating], fill: float) -> NDArray[Floating]:
            return np.pad(values, ((0, 0), (0, 1), (0, 0)), constant_values=fill)

        self._active = np.pad(self._active, ((0, 0), (0, 1)))
        self._poses = padded(self._poses, np.nan)
        self._velocities = padded(self._velocities, 0.0)
        self._turn_ranges = padded(self._turn_ranges, np.inf)
        self._offsets = padded(self._offsets, 0.0)
        self._newest = padded(self._newest, np.inf)
        self._shown, self._turn_start = padded(self._shown, np.nan), padded(self._turn_start, np.nan)
        self._finished = deque(
            (when, padded(ranges, np.inf), padded(shown, np.nan)) for when, ranges, shown in self._finished
        )


def _sequences(
    seeds: Sequence[int | np.random.SeedSequence] | None, worlds: int, needed: bool
) -> list[np.random.SeedSequence]:
    """Return one seed sequence for every world."""
    if seeds is None:
        require(not needed, "the profile has random errors; one seed for every world is needed")
        return []
    require(len(seeds) == worlds, f"{len(seeds)} seeds given for {worlds} worlds; one for each is needed")
    return [seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed) for seed in seeds]
