"""LiDAR scans of batched worlds: exact ranges, rolling turns, and the sensor's errors."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import DTypeLike, NDArray

from triform.geometry.cells import SMALL_TEAM, list_cells, make_cells
from triform.geometry.footprint import Footprint
from triform.simulation.arena import Arena
from triform.simulation.body_kernels import Bodies
from triform.simulation.cast_kernels import cast_cells, cast_world, cast_worlds, sort_poses
from triform.simulation.moving_ray_kernels import HIT_NOTHING, cast_moving_worlds
from triform.simulation.profiles import LidarConfig, NoiseBand
from triform.simulation.ray_kernels import ScanRays, Scene
from triform.threads import in_parts, usable_threads
from triform.types import BoolArray, ConfigurationError, FloatArray, RangeArray, ScanConfig, as_array, require

__all__ = ["angle_offsets", "apply_noise", "cast_rolling", "cast_scans", "cast_world", "noise_sigma", "scan_rays"]

#: What rays hit, see ``cast_moving``.
HitArray = NDArray[np.int32]

#: Rays that keep a thread busy for about 2 ms.
RAYS_PER_THREAD = 1_000_000
#: The same where every ray is cast by itself, at its own moment or perturbed angle: about 20 times slower.
MOVING_RAYS_PER_THREAD = 50_000


def _checked_batch(poses: FloatArray, active: BoolArray) -> tuple[FloatArray, BoolArray]:
    poses, active = as_array("poses", poses), as_array("flags of active robots", active, np.bool_)
    if poses.ndim != 3 or poses.shape[2] != 3 or active.shape != poses.shape[:2]:
        raise ConfigurationError(
            f"poses of shape {poses.shape} and active of shape {active.shape} given; (B, N, 3) and (B, N) are needed"
        )
    if not np.isfinite(poses[active]).all():
        raise ConfigurationError("the poses of active robots must be finite")
    return poses, active


@functools.lru_cache(maxsize=16)
def scan_rays(config: ScanConfig, x: float = 0.0, y: float = 0.0) -> ScanRays:
    """Return the rays of a scan from (x, y) in the robot's frame [m] as the kernels take them."""
    angles = config.angles
    limits = (float(config.angle_min), float(config.range_min), float(config.range_max))
    return ScanRays(*limits, np.cos(angles), np.sin(angles), float(x), float(y))


def cast_scans(
    poses: FloatArray,
    active: BoolArray,
    footprint: Footprint | Sequence[Footprint],
    arena: Arena,
    config: ScanConfig,
    offsets: FloatArray | None = None,
    dtype: DTypeLike = np.float64,
    eye: tuple[float, float] = (0.0, 0.0),
    robots: slice = slice(None),
    hits: HitArray | None = None,
) -> RangeArray:
    """Return what every robot's LiDAR would measure at one instant, without range noise.

    Args:
        poses: World-frame poses, shape (B, N, 3) [m, m, rad].
        active: Which robots exist, shape (B, N); the others are not seen and see nothing.
        footprint: Outline of all robots, or of each; no robot sees its own.
        arena: Walls and pillars.
        config: Rays and limits of range.
        offsets: Errors of the rays' angles, shape (B, M, R) [rad].
        dtype: Floating type of the ranges.
        eye: Where the LiDAR is on each robot, forward and left of its centre [m].
        robots: Which M robots measure; by default all.
        hits: Gets what every ray hits, int32, shape (B, M, R), see ``cast_moving``; rays are then cast one by one.

    Returns:
        Ranges, shape (B, M, R) [m]: ``+inf`` beyond ``range_max``, ``-inf`` below ``range_min`` and throughout for
        a robot whose LiDAR lies inside an obstacle.

    Raises:
        ConfigurationError: If the shapes do not fit, or the pose of an active robot is not finite.
    """
    if offsets is not None or hits is not None:
        return cast_rolling(poses, poses, active, footprint, arena, config, offsets, dtype, eye, robots, hits)
    places, mask = _checked_batch(poses, active)
    worlds, total = mask.shape
    ranges = np.empty((worlds, total, config.rays), dtype)
    scene, rays = make_scene(footprint, arena, total), scan_rays(config, *eye)
    if total <= SMALL_TEAM or worlds >= usable_threads():
        in_parts(
            lambda first, last: cast_worlds(places, mask, scene, rays, ranges, first, last),
            worlds, ranges.size, RAYS_PER_THREAD,
        )  # fmt: skip
        return ranges[:, robots]
    for b in range(worlds):
        _cast_large(places[b], mask[b], scene, rays, ranges[b])
    return ranges[:, robots]


def make_scene(footprint: Footprint | Sequence[Footprint], arena: Arena, robots: int) -> Scene:
    """Return the outline of all robots, or of each, with walls and pillars as kernels take them.

    Raises:
        ConfigurationError: The number of outlines is not that of robots.
    """
    if isinstance(footprint, Footprint):
        return Scene(footprint.body, arena.walls, arena.pillars)
    require(len(footprint) == robots, f"{len(footprint)} footprints given for {robots} robots; one for each is needed")
    return Scene(Bodies.of([each.body for each in footprint]), arena.walls, arena.pillars)


def _cast_large(poses: FloatArray, active: BoolArray, scene: Scene, rays: ScanRays, ranges: RangeArray) -> None:
    """Cast the scans of one world, its cells shared out over the threads."""
    ranges[~active] = np.inf
    world = make_cells(poses, active)
    cells = list_cells(world)
    in_slots, axes = sort_poses(world, poses)
    in_parts(
        lambda first, last: cast_cells(world, cells[first:last], in_slots, axes, scene, rays, ranges),
        len(cells), ranges.size, RAYS_PER_THREAD,
    )  # fmt: skip


def cast_rolling(
    start: FloatArray,
    end: FloatArray,
    active: BoolArray,
    footprint: Footprint | Sequence[Footprint],
    arena: Arena,
    config: ScanConfig,
    offsets: FloatArray | None = None,
    dtype: DTypeLike = np.float64,
    eye: tuple[float, float] = (0.0, 0.0),
    robots: slice = slice(None),
    hits: HitArray | None = None,
) -> RangeArray:
    """Return a turn in which ray k is measured at the share k / R of the way from ``start`` to ``end``.

    Positions move linearly and headings along the shorter turn; everybody, observer and observed, moves.

    Args:
        start: Poses when ray 0 is measured, shape (B, N, 3) [m, m, rad].
        end: Poses one turn later, shape (B, N, 3) [m, m, rad].
        active: Which robots exist, shape (B, N).
        footprint: Outline of all robots, or of each.
        arena: Walls and pillars.
        config: Rays and limits of range.
        offsets: Errors of the rays' angles, shape (B, M, R) [rad].
        dtype: Floating type of the ranges.
        eye: Where the LiDAR is on each robot, forward and left of its centre [m].
        robots: Which M robots measure; by default all.
        hits: Gets what every ray hits, int32, shape (B, M, R), see ``cast_moving``.

    Returns:
        Ranges, shape (B, M, R) [m], as ``cast_scans``.

    Raises:
        ConfigurationError: If the shapes do not fit, or the pose of an active robot is not finite.
    """
    placed, mask = _checked_batch(start, active)
    end = placed if end is start else _checked_batch(end, active)[0]
    start = placed
    observers = range(start.shape[1])[robots]
    shape = (len(start), len(observers), config.rays)
    errors = np.empty((*shape[:2], 0)) if offsets is None else as_array("angle offsets", offsets)
    if offsets is not None and errors.shape != shape:
        raise ConfigurationError(f"angle offsets of shape {errors.shape} given; {shape} is needed")
    ranges = np.full(shape, np.inf, dtype)
    share_step = 0.0 if start is end else 1.0 / config.rays
    scene = make_scene(footprint, arena, start.shape[1])
    found = np.empty((*shape[:2], 0), np.int32) if hits is None else hits
    found[...] = HIT_NOTHING
    turn = (scan_rays(config, *eye), errors, share_step, observers.start, ranges, found)
    in_parts(
        lambda first, last: cast_moving_worlds(start, end, mask, scene, *turn, first, last),
        len(ranges), ranges.size, MOVING_RAYS_PER_THREAD,
    )  # fmt: skip
    return ranges


def noise_sigma(ranges: RangeArray, noise: tuple[NoiseBand, ...]) -> FloatArray:
    """Return the standard deviation of the range noise at true ``ranges`` [m], 0 where there is no return."""
    finite = np.isfinite(ranges)
    if not noise:
        return np.zeros(ranges.shape)
    distance = np.where(finite, ranges, 0.0)
    band = np.searchsorted([each.up_to for each in noise], distance)
    absolute = np.array([each.absolute for each in noise])[band]
    relative = np.array([each.relative for each in noise])[band]
    return np.where(finite, absolute + relative * distance, 0.0)


def angle_offsets(shape: tuple[int, ...], lidar: LidarConfig, rng: np.random.Generator) -> FloatArray:
    """Return errors of the rays' angles [rad], shape ``shape``, to cast with."""
    if lidar.angle_noise == 0.0:
        return np.zeros(shape)
    return rng.normal(0.0, lidar.angle_noise, shape)


def apply_noise(ranges: RangeArray, lidar: LidarConfig, rng: np.random.Generator) -> RangeArray:
    """Return ``ranges`` with Gaussian range noise and dropped rays; angle noise belongs into the casting.

    Args:
        ranges: Exact ranges, shape (..., R) [m].
        lidar: The sensor.
        rng: Source of randomness.

    Returns:
        Measured ranges: what the noise carries beyond a limit of range becomes ``+inf`` or ``-inf``, and a share
        ``dropout`` of all rays ``NaN``.
    """
    measured = ranges
    if lidar.noise:
        measured = ranges + noise_sigma(ranges, lidar.noise) * rng.standard_normal(ranges.shape)
        measured[measured > lidar.scan.range_max] = np.inf
        measured[measured < lidar.scan.range_min] = -np.inf
    if lidar.dropout > 0.0:
        measured = np.where(rng.random(ranges.shape) < lidar.dropout, np.nan, measured)
    return measured
