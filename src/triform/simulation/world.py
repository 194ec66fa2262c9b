"""The built-in world: many independent teams at once, one time for all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from triform.mixed import MixedView
from triform.simulation.arena import Arena, get_arena
from triform.simulation.composition import Composition
from triform.simulation.kinematics import drive_limits, integrate, limit_twists
from triform.simulation.lidar import MOVING_RAYS_PER_THREAD, HitArray, cast_scans, make_scene, scan_rays
from triform.simulation.profiles import Profile
from triform.simulation.sensors import SensorSuite, padded, stretches
from triform.simulation.spawning import sample_starts, world_seeds
from triform.simulation.world_kernels import Contacts, LidarTurn, Motion, advance_worlds, record_contacts
from triform.threads import in_parts
from triform.types import (
    SIGHT,
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
#: Moments closer than this are the same moment [s].
_SAME_TIME = 1e-9


@dataclass
class _Kind:
    """The robots of one profile.

    Attributes:
        profile: What they are.
        robots: Which they are, along axis N.
        senses: What they sense.
        period: Number of the control period in which they got their command.
    """

    profile: Profile
    robots: slice
    senses: SensorSuite
    period: int = -1


class World:
    """``B`` worlds of up to ``N`` robots: a ``Team[PrivilegedView]``.

    Robots measure while everybody moves, and a view shows what ``SensorSuite`` says, from a first scan at time 0 on.

    Physical contact is not simulated: robots pass through each other, walls and pillars, and overlaps are
    recorded.

    Robots may be of several kinds. The world then shows a ``MixedView``, and each robot takes commands once per control
    period of its own.

    Every world draws from generators of its own, one for each robot. A world's run is the same to the bit whatever
    the number of threads and whatever other worlds are in the batch.
    """

    def __init__(
        self,
        poses: ArrayLike,
        profile: Profile | Composition,
        arena: Arena | None = None,
        seeds: Sequence[int | np.random.SeedSequence] | None = None,
        active: ArrayLike | None = None,
        from_lidar: bool = False,
    ) -> None:
        """Place the robots at rest.

        Args:
            poses: Poses in the world frame, shape (B, N, 3) [m, m, rad].
            profile: Kind of all robots, or of each.
            arena: Walls and pillars; by default none.
            seeds: One seed for every world; may be left out if the profile has no random errors.
            active: Which robots exist, shape (B, N); by default all.
            from_lidar: Whether views show scans as the LiDARs measure them, each from where it is mounted, as the
                driver of a real one does; controllers want them from the base's centre.

        Raises:
            ConfigurationError: If shapes do not fit, an active robot's pose is not finite, or seeds are missing.
        """
        composition = Composition.of(profile)
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
        self._composition = composition
        self._arena = Arena.open() if arena is None else arena
        # A pose moved by nothing has its heading wrapped.
        self._poses = integrate(placed, np.zeros_like(placed), 0.0)
        self._velocities = np.zeros_like(placed)
        self._min_distance = np.full(worlds, np.inf)
        self._collided = np.zeros(worlds, dtype=np.bool_)
        self._hit_arena = np.zeros(worlds, dtype=np.bool_)
        self._time = 0.0
        self._held = np.zeros_like(placed)
        self._kinds: list[_Kind] = []
        for each, own in zip(composition.profiles, composition.slices(robots), strict=True):
            given = (self._poses[:, own], self._active[:, own], seeds, self._arena, from_lidar, own.start)
            self._kinds.append(_Kind(each, own, SensorSuite(each, *given)))
        self._arrange()
        self._record()
        for kind in self._kinds:
            if not kind.profile.lidar.rolling:
                ranges, hits = self._snapshot(kind)
                kind.senses.finish(ranges, self._poses[:, kind.robots], self._active[:, kind.robots], hits)

    @property
    def composition(self) -> Composition:
        """Kinds of robots."""
        return self._composition

    @property
    def profile(self) -> Profile:
        """Kind of all robots.

        Raises:
            ConfigurationError: There are several.
        """
        return self._composition.profile

    @property
    def newcomer(self) -> Profile:
        """Kind of a robot that joins and takes no place of one that left: the last."""
        return self._kinds[-1].profile

    @property
    def arena(self) -> Arena:
        """Walls and pillars."""
        return self._arena

    @property
    def control_period(self) -> float:
        """Time between two commands [s]; of several kinds, the longest that fits the periods of all."""
        return self._composition.control_period

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
        parts = []
        for kind in self._kinds:
            own = kind.robots
            state = self._poses[:, own], self._velocities[:, own], self._active[:, own]
            parts.append(kind.senses.view(self._time, *state))
        return MixedView(parts, self._due, self._held.copy()) if self._composition.is_mixed else parts[0]

    def apply(self, commands: FloatArray, duration: float) -> None:
        """Hold body twists for a while.

        Args:
            commands: Body twists, shape (B, N, 3) [m/s, m/s, rad/s]; those of inactive robots are not used.
            duration: How long [s]. It is cut at the ends of LiDAR turns, and each part is integrated in equal steps
                of at most the profile's ``time_step``. Of several kinds, only those take their commands whose control
                period begins now; the others hold theirs.

        Raises:
            TriformError: If the shape does not fit, a command is not finite, or the duration is not positive.
        """
        duration = converted("duration", duration, float)
        targets = self._take(self._checked(commands))
        end = self._time + duration
        for stop, ending in stretches([kind.senses for kind in self._kinds], self._time, duration):
            self._advance(targets, stop - self._time, ending)
            self._time = stop
            for kind in self._kinds:
                if kind.senses in ending:
                    ranges, hits = (None, None) if kind.profile.lidar.rolling else self._snapshot(kind)
                    kind.senses.end_turn(ranges, self._poses[:, kind.robots], self._active[:, kind.robots], hits)
        self._time = end

    def add_robot(self, world: int, pose: ArrayLike) -> int:
        """Add a robot at rest to one world; the axis N grows if no place is free.

        Of several kinds, it is of that of the one whose place it takes, or else of the last.

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
        placed = _checked_pose(pose)
        free = np.flatnonzero(~self._active[world])
        if len(free) == 0:
            self._grow()
        robot = int(free[0]) if len(free) else self._active.shape[1] - 1
        self._place(world, robot, placed)
        return robot

    def move_robot(self, world: int, robot: int, pose: ArrayLike) -> None:
        """Put a robot elsewhere, at rest, as if it left and joined there with its own place along axis N.

        Args:
            world: Index of the world.
            robot: Index of the robot along axis N.
            pose: Pose in the world frame, shape (3,) [m, m, rad].

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
        self._poses[world, robot] = np.nan
        self._velocities[world, robot] = self._held[world, robot] = 0.0
        kind = self._kind_of(robot)
        kind.senses.remove_robot(world, robot - kind.robots.start)

    def _place(self, world: int, robot: int, pose: FloatArray) -> None:
        """Let a robot begin at ``pose``, shape (3,), at rest."""
        self._active[world, robot] = True
        self._poses[world, robot] = integrate(pose, np.zeros(3), 0.0)
        self._velocities[world, robot] = self._held[world, robot] = 0.0
        kind = self._kind_of(robot)
        kind.senses.add_robot(world, robot - kind.robots.start, self._poses[world, robot])
        self._record()

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

    def _arrange(self) -> None:
        """Set what kernels need to know of the kinds, for the present number of robots."""
        composition, robots = self._composition, self._active.shape[1]
        self._outlines = composition.outlines(robots)
        self._scene = make_scene(self._outlines, self._arena, robots)
        self._bounds = np.array([0, *(kind.robots.stop for kind in self._kinds)])
        self._limits = np.stack([drive_limits(profile.drive) for profile in composition.profiles])

    def _kind_of(self, robot: int) -> _Kind:
        return next(kind for kind in self._kinds if robot < kind.robots.stop)

    @property
    def _due(self) -> list[bool]:
        """Which kinds take a command now."""
        return [kind.period != self._period(kind) for kind in self._kinds]

    def _period(self, kind: _Kind) -> int:
        return math.floor((self._time + _SAME_TIME) / kind.profile.control_period)

    def _take(self, commands: FloatArray) -> FloatArray:
        """Give commands to the robots that take some now, and return what all are steering to."""
        if not self._composition.is_mixed:
            return limit_twists(commands, self._kinds[0].profile.drive)
        for kind, due in zip(self._kinds, self._due, strict=True):
            if due:
                kind.period = self._period(kind)
                own = np.where(self._active[:, kind.robots, None], commands[:, kind.robots], 0.0)
                self._held[:, kind.robots] = own
        return np.concatenate([limit_twists(self._held[:, kind.robots], kind.profile.drive) for kind in self._kinds], 1)

    @property
    def _contacts(self) -> Contacts:
        return Contacts(self._min_distance, self._collided, self._hit_arena)

    def _record(self) -> None:
        record = partial(record_contacts, self._poses, self._active, self._scene, self._contacts)
        in_parts(record, len(self._active), self._active.size, RECORDS_PER_THREAD)

    def _advance(self, targets: FloatArray, duration: float, ending: Sequence[SensorSuite]) -> None:
        """Move by ``duration`` [s], which lies within one turn of each LiDAR."""
        time_step = min(kind.profile.time_step for kind in self._kinds)
        substeps = max(1, math.ceil(duration / time_step - 1e-6))
        step = duration / substeps
        # Driving a robot for a step takes about as long as casting two rays.
        work = 2 * substeps * self._active.size
        turns = []
        for kind in self._kinds:
            profile, senses = kind.profile, kind.senses
            due = senses.rays_due(self._time, substeps, step, senses in ending)
            rays = scan_rays(profile.from_lidar, profile.mounting.x, profile.mounting.y)
            ray_period = profile.lidar.period / profile.lidar.scan.rays
            begun = (kind.robots.start, due, senses.elapsed(self._time), ray_period, rays)
            turns.append(LidarTurn(*begun, senses.offsets, senses.ranges, senses.hits))
            work += int(due[-1] - due[0]) * self._active[:, kind.robots].size
        casts = any(turn.ray_bounds[-1] > turn.ray_bounds[0] for turn in turns)
        state = (self._poses, self._velocities, targets, self._active)
        motion = Motion(*state, self._bounds, self._limits, step, casts)
        advance = partial(advance_worlds, motion, self._scene, self._contacts, tuple(turns))
        in_parts(advance, len(self._active), work, MOVING_RAYS_PER_THREAD)

    def _snapshot(self, kind: _Kind) -> tuple[RangeArray, HitArray | None]:
        """All rays of one kind at this moment, without range noise, and what they hit if intensities are asked for."""
        profile, robots, active = kind.profile, kind.robots, self._active[:, kind.robots]
        hits, eye = kind.senses.no_hits(active), (profile.mounting.x, profile.mounting.y)
        scene = (self._outlines, self._arena, profile.from_lidar, kind.senses.draw_offsets(active), np.float32, eye)
        return np.ascontiguousarray(cast_scans(self._poses, self._active, *scene, robots, hits)), hits

    def _grow(self) -> None:
        """Append one place to axis N of everything."""
        self._active = np.pad(self._active, ((0, 0), (0, 1)))
        self._poses = padded(self._poses, np.nan)
        self._velocities, self._held = padded(self._velocities, 0.0), padded(self._held, 0.0)
        self._kinds[-1].robots = slice(self._kinds[-1].robots.start, self._active.shape[1])
        self._kinds[-1].senses.grow()
        self._arrange()


def _checked_pose(pose: ArrayLike) -> FloatArray:
    """Return a pose as an array, shape (3,), or refuse it."""
    placed = as_array("numbers of a pose", pose)
    if placed.shape != (3,) or not np.isfinite(placed).all():
        raise TriformError(f"a robot cannot be placed at {placed}; a pose is three finite numbers")
    return placed


def make_world(
    robots: int | None = None,
    seed: int = 7,
    runs: int = 1,
    profile: str = "ideal",
    arena: str = "open",
    distance: float = 1.0,
    sight: float = SIGHT,
) -> World:
    """Return worlds at their random starts: runs 0, 1, ... of an evaluation with the same settings.

    Args:
        robots: Robots of each team, N; by default 9, or as many as the profiles say.
        seed: Seed of starts and noise.
        runs: Number of worlds, B.
        profile: Robot profile: a name or a TOML file; of several kinds each with its number of robots, such as
            ``turtlebot4:3 hardware:2``.
        arena: Arena: a name or a TOML file.
        distance: Prescribed neighbour distance d* [m].
        sight: How far robots look with their LiDARs [d*].

    Raises:
        ConfigurationError: A name is unknown or a number not allowed.
    """
    runs, distance = converted("runs", runs, int), converted("distance", distance, float)
    require(runs >= 1, f"runs is {runs}; at least 1 is needed")
    require(0 < distance < np.inf, f"distance is {distance} m; it must be positive and finite")
    composition = Composition.parse(profile).changed(lambda kind: kind.seeing(sight * distance))
    robots = composition.team_size(robots, 9)
    poses = sample_starts(robots, runs, seed, distance=distance)
    seeds = world_seeds(robots, seed, range(runs))
    return World(poses, composition, get_arena(arena), seeds)
