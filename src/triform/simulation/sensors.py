"""What simulated robots sense: LiDAR turns that take their time, odometry and exploration noise."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from triform.simulation.arena import Arena
from triform.simulation.lidar import HitArray, angle_offsets, apply_noise
from triform.simulation.mounting import Mounting, Placement
from triform.simulation.moving_ray_kernels import HIT_NOTHING
from triform.simulation.noise import noise_in_body, noise_keys
from triform.simulation.odometry import halfway, relative_poses, resting_poses
from triform.simulation.pace import pace
from triform.simulation.profiles import Profile
from triform.types import (
    BoolArray,
    FloatArray,
    IntArray,
    PrivilegedView,
    RangeArray,
    Scan,
    TriformError,
    converted,
    require,
)

Floating = TypeVar("Floating", bound=np.floating[Any])

#: Moments closer than this are the same moment [s].
_SAME_TIME = 1e-9


class SensorSuite:
    """What N robots of one kind sense in B worlds, whatever moves the robots and casts the rays.

    A LiDAR turn lasts one period. With a rolling LiDAR ray k is measured at the share k / R of the turn; otherwise all
    rays are measured at the end of the turn. A finished scan can be observed after the profile's latency; until the
    first one can, nothing is seen (``+inf`` throughout). The moment that a rolling scan shows is the middle of its
    turn. Odometry is exact.

    Every robot draws its errors from a generator of its own, a function of its world's seed and its index alone.

    Attributes:
        ranges: What a rolling LiDAR has measured in the running turn [m], shape (B, N, R), written by whoever casts
            the rays; R is 0 for a LiDAR that measures all rays at once.
        offsets: Errors of the angles of these rays [rad], shape (B, N, R); R is 0 without such errors.
        hits: What these rays hit, see ``cast_moving``, written with them, shape (B, N, R); R is 0 unless ``is_bright``.
        is_bright: Whether intensities are simulated: of a LiDAR with ``min_intensity``, which needs them.
    """

    def __init__(
        self,
        profile: Profile,
        poses: FloatArray,
        active: BoolArray,
        seeds: Sequence[int | np.random.SeedSequence] | None = None,
        arena: Arena | None = None,
        from_lidar: bool = False,
        first: int = 0,
    ) -> None:
        """Begin the first turn at time 0.

        Args:
            profile: Kind of all these robots.
            poses: Poses in the world frame, shape (B, N, 3) [m, m, rad].
            active: Which robots exist, shape (B, N).
            seeds: One seed for every world; may be left out if the profile has no random errors.
            arena: What is there besides robots; without it, the intensities of what rays hit are not known.
            from_lidar: Whether scans are shown as the LiDARs measure them, and not as seen from the base's centre.
            first: Index of the first of these robots in its team, on which their errors and their noise depend.

        Raises:
            ConfigurationError: If seeds are missing.
        """
        self._first = first
        lidar = profile.lidar
        self._profile = profile
        # What is measured reaches as far from the LiDAR as a view does from the base.
        self._measured = replace(lidar, scan=profile.from_lidar)
        self._shown_scan = self._measured.scan if from_lidar else lidar.scan
        as_measured = from_lidar or profile.mounting == Mounting()
        self._placement = None if as_measured else Placement(lidar.scan, profile.mounting)
        self._noisy = bool(lidar.noise) or lidar.angle_noise > 0 or lidar.dropout > 0
        self.is_bright = lidar.min_intensity is not None and arena is not None
        self._levels = (arena or Arena.open()).levels(lidar.brightness)
        self._seeds = _sequences(seeds, len(poses), self._noisy or self.is_bright)
        self._rngs: dict[tuple[int, ...], np.random.Generator] = {}
        self._noise_keys, self._pace = noise_keys(self._seeds, len(poses)), pace(profile)
        self._turn = 0
        self._next_ray = 0
        # Until there is a scan, one number stands for all rays.
        self._newest: RangeArray = np.broadcast_to(np.float32(np.inf), (*active.shape, lidar.scan.rays))
        self._newest_bright: RangeArray | None = None
        self._shown: FloatArray = poses.copy()
        self._finished: deque[tuple[float, RangeArray, RangeArray | None, FloatArray]] = deque()
        self.ranges: RangeArray
        self.hits: HitArray
        self.offsets: FloatArray
        self._turn_start: FloatArray
        self._begin_turn(poses, active)

    def stretches(self, time: float, duration: float) -> Iterator[tuple[float, bool]]:
        """As ``stretches`` of this suite alone."""
        return ((stop, bool(ending)) for stop, ending in stretches((self,), time, duration))

    @property
    def turn_end(self) -> float:
        """When the running turn ends [s]."""
        return (self._turn + 1) * self._profile.lidar.period

    def rays_due(self, time: float, steps: int, step: float, turn_ends: bool) -> IntArray:
        """Tell which rays of the running turn a rolling LiDAR measures while time advances in equal steps.

        Args:
            time: Present time [s].
            steps: Number of steps, all of them within the turn.
            step: Length of each [s].
            turn_ends: Whether the last one ends the turn.

        Returns:
            Number of rays that have fallen due before each step and after the last, shape (steps + 1,); all 0 for a
            LiDAR that measures all rays at once. They then count as measured.
        """
        lidar = self._profile.lidar
        if not lidar.rolling:
            return np.zeros(steps + 1, dtype=np.int64)
        ends = self.elapsed(time) + step * np.arange(steps + 1)
        due = np.ceil(ends * (lidar.scan.rays / lidar.period) - 1e-6).astype(np.int64)
        bounds = np.clip(due, self._next_ray, lidar.scan.rays)
        bounds[0] = self._next_ray
        if turn_ends:
            bounds[-1] = lidar.scan.rays
        self._next_ray = int(bounds[-1])
        return cast(IntArray, bounds)

    def elapsed(self, time: float) -> float:
        """How long the running turn has lasted [s]."""
        return time - self._turn * self._profile.lidar.period

    def draw_offsets(self, active: BoolArray) -> FloatArray | None:
        """Errors of the angles of rays that are all measured at once [rad], shape (B, N, R); ``None`` without any."""
        if self._profile.lidar.angle_noise > 0:
            return self._draw_offsets((*active.shape, self._profile.lidar.scan.rays), active)
        return None

    def no_hits(self, active: BoolArray) -> HitArray | None:
        """Return an array for what rays hit that are all cast at once, shape (B, N, R); ``None`` if unneeded."""
        shape = (*active.shape, self._profile.lidar.scan.rays)
        return np.full(shape, HIT_NOTHING, np.int32) if self.is_bright else None

    def finish(self, ranges: RangeArray, poses: FloatArray, active: BoolArray, hits: HitArray | None = None) -> None:
        """Finish a scan at the beginning of the running turn: of a LiDAR that measures all rays at once.

        Args:
            ranges: What was measured from where the LiDAR is, without errors of range [m], shape (B, N, R); errors are
                put in, and a mounting off the centre or with blind sectors is allowed for.
            poses: Poses at this moment, shape (B, N, 3).
            active: Which robots exist, shape (B, N).
            hits: What the rays hit, shape (B, N, R), from ``no_hits``.
        """
        bright = None if hits is None else self._intensities(ranges, hits, active)
        if self._noisy:
            for b, i in np.argwhere(active):
                ranges[b, i] = apply_noise(ranges[b, i], self._measured, self._rng(b, i))
        if self._placement is not None:
            masked, levels = self._placement.masked(ranges[active]), None if bright is None else bright[active]
            ranges[active], levels = self._placement.from_base(masked, levels)
            if bright is not None:
                bright[active] = levels
        shown = halfway(self._turn_start, poses, active) if self._profile.lidar.rolling else poses.copy()
        self._finished.append((self._turn * self._profile.lidar.period, ranges, bright, shown))

    def end_turn(
        self, ranges: RangeArray | None, poses: FloatArray, active: BoolArray, hits: HitArray | None = None
    ) -> None:
        """Finish the scan of the running turn, and begin the next.

        Args:
            ranges: All rays at this moment, without errors of range; ``None`` for a rolling LiDAR.
            poses: As for ``finish``.
            active: As for ``finish``.
            hits: As for ``finish``; ``None`` for a rolling LiDAR.
        """
        self._turn += 1
        if ranges is None:
            ranges, hits = self.ranges, self.hits if self.is_bright else None
        self.finish(ranges, poses, active, hits)
        self._next_ray = 0
        self._begin_turn(poses, active)

    def view(self, time: float, poses: FloatArray, velocities: FloatArray, active: BoolArray) -> PrivilegedView:
        """Return the newest scans whose latency has passed, odometry, exploration noise, and everybody's true pose.

        Args:
            time: Present time [s].
            poses: Poses in the world frame, shape (B, N, 3).
            velocities: Body twists, shape (B, N, 3), which wheels know too.
            active: Which robots exist, shape (B, N).
        """
        ready = time - self._profile.latency + _SAME_TIME
        while self._finished and self._finished[0][0] <= ready:
            _, self._newest, self._newest_bright, self._shown = self._finished.popleft()
        drive = self._profile.drive
        resting = resting_poses(poses, velocities, drive)
        odometry = relative_poses(resting, self._shown, active) if self._profile.odometry else None
        headings = np.where(active, resting[..., 2], 0.0)
        return PrivilegedView(
            scans=Scan(self._newest, self._shown_scan, self._newest_bright),
            active=active.copy(),
            time=time,
            poses=poses.copy(),
            noise=noise_in_body(self._noise_keys, drive, time, headings, self._first, self._pace),
            odometry=odometry,
        )

    def add_robot(self, world: int, robot: int, pose: FloatArray) -> None:
        """Let a robot begin at ``pose``, shape (3,); of a rolling turn the rays already past are ``NaN``."""
        for shown in (self._shown, self._turn_start, *(poses for *_, poses in self._finished)):
            shown[world, robot] = pose
        self.ranges[world, robot, : self._next_ray] = np.nan
        self.ranges[world, robot, self._next_ray :] = np.inf
        if self._profile.lidar.rolling and self._noisy:
            self.offsets[world, robot] = angle_offsets(
                self.offsets.shape[2:], self._profile.lidar, self._rng(world, robot)
            )

    def remove_robot(self, world: int, robot: int) -> None:
        """Make the scans of a robot ``+inf``."""
        self.ranges[world, robot] = np.inf
        # Views handed out earlier share these arrays and must not change.
        self._newest = self._newest.copy()
        self._newest[world, robot] = np.inf
        for _, ranges, _, _ in self._finished:
            ranges[world, robot] = np.inf

    def grow(self) -> None:
        """Append one place to axis N of everything."""
        self.ranges = padded(self.ranges, np.inf)
        self.offsets = padded(self.offsets, 0.0)
        self.hits = np.pad(self.hits, ((0, 0), (0, 1), (0, 0)), constant_values=HIT_NOTHING)
        self._newest, self._newest_bright = padded(self._newest, np.inf), _padded_bright(self._newest_bright)
        self._shown, self._turn_start = padded(self._shown, np.nan), padded(self._turn_start, np.nan)
        self._finished = deque(
            (when, padded(ranges, np.inf), _padded_bright(bright), padded(shown, np.nan))
            for when, ranges, bright, shown in self._finished
        )

    def _begin_turn(self, poses: FloatArray, active: BoolArray) -> None:
        """Begin a turn in which nothing has been measured."""
        lidar = self._profile.lidar
        self._turn_start = poses.copy()
        shape = (*active.shape, lidar.scan.rays if lidar.rolling else 0)
        self.ranges = np.full(shape, np.inf, np.float32)
        self.hits = np.full((*shape[:2], shape[2] if self.is_bright else 0), HIT_NOTHING, np.int32)
        self.offsets = self._draw_offsets(shape, active) if lidar.angle_noise > 0 else np.empty((*shape[:2], 0))

    def _draw_offsets(self, shape: tuple[int, ...], active: BoolArray) -> FloatArray:
        offsets = np.zeros(shape)
        if shape[2] > 0:
            for b, i in np.argwhere(active):
                offsets[b, i] = angle_offsets(shape[2:], self._profile.lidar, self._rng(b, i))
        return offsets

    def _intensities(self, ranges: RangeArray, hits: HitArray, active: BoolArray) -> RangeArray:
        """How bright exact returns are, shape (B, N, R); 0 where nothing returned."""
        bright = np.zeros(ranges.shape, np.float32)
        for b, i in np.argwhere(active):
            # A stream of their own: ranges are the same with and without them.
            rng = self._rng(b, i, 0)
            bright[b, i] = self._measured.brightness.measure(self._levels[hits[b, i]], ranges[b, i], rng)
        return bright

    def _rng(self, world: int, *robot: int) -> np.random.Generator:
        """Generator of one robot, or of its intensities alone with a further 0."""
        if (world, *robot) not in self._rngs:
            seed = self._seeds[world]
            own = (self._first + robot[0], *robot[1:])
            sequence = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, *own))
            self._rngs[world, *robot] = np.random.default_rng(sequence)
        return self._rngs[world, *robot]


def stretches(
    suites: Sequence[SensorSuite], time: float, duration: float
) -> Iterator[tuple[float, tuple[SensorSuite, ...]]]:
    """Cut a while at the ends of LiDAR turns; whoever moves the robots ends turns before asking for the next cut.

    Args:
        suites: What the robots of each kind sense.
        time: Present time [s].
        duration: How long commands are held [s].

    Yields:
        The end of a stretch [s], and the suites whose running turns it ends.

    Raises:
        TriformError: The duration is not positive and finite.
    """
    if not 0 < duration < math.inf:
        raise TriformError(f"commands cannot be held for {duration} s; the time must be positive and finite")
    end = time + duration
    while end - time > _SAME_TIME:
        turn_end = min(suite.turn_end for suite in suites)
        time = turn_end if turn_end < end - _SAME_TIME else end
        yield time, tuple(suite for suite in suites if suite.turn_end <= time + _SAME_TIME)


def padded(values: NDArray[Floating], fill: float) -> NDArray[Floating]:
    """Append one place to axis N of an array of shape (B, N, ...)."""
    return np.pad(values, ((0, 0), (0, 1), (0, 0)), constant_values=fill)


def _padded_bright(values: RangeArray | None) -> RangeArray | None:
    """``padded`` for intensities, where there are any."""
    return None if values is None else padded(values, 0.0)


def _sequences(
    seeds: Sequence[int | np.random.SeedSequence] | None, worlds: int, needed: bool
) -> list[np.random.SeedSequence]:
    """Return one seed sequence for every world."""
    if seeds is None:
        require(not needed, "the profile has random errors; one seed for every world is needed")
        return []
    require(len(seeds) == worlds, f"{len(seeds)} seeds given for {worlds} worlds; one for each is needed")
    for seed in seeds:
        fits = isinstance(seed, np.random.SeedSequence) or converted("seed", seed, int) >= 0
        require(fits, f"seed is {seed}; it must not be negative")
    return [seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed) for seed in seeds]
