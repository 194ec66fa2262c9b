"""Compiled advance of batched worlds: drive, record contacts, measure the rays that fall due."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange

from triform.simulation._contact_kernels import any_hits_arena, any_robots_overlap, closest_pair
from triform.simulation._drive_kernels import drive_robot
from triform.simulation._moving_ray_kernels import cast_moving


@njit(cache=True, nogil=True)
def _record_world(
    b: int,
    poses: Any,
    active: Any,
    half_length: float,
    half_width: float,
    is_circle: bool,
    walls: Any,
    pillars: Any,
    min_distance: Any,
    collided: Any,
    hit_arena: Any,
) -> None:
    distance = closest_pair(poses[b], active[b])
    min_distance[b] = min(min_distance[b], distance)
    around = half_length if is_circle else math.hypot(half_length, half_width)
    if not collided[b] and distance < 2 * around:
        collided[b] = any_robots_overlap(poses[b], active[b], half_length, half_width, is_circle)
    if not hit_arena[b]:
        hit_arena[b] = any_hits_arena(poses[b], active[b], half_length, half_width, is_circle, walls, pillars)


@njit(cache=True, nogil=True)
def record_contacts(
    poses: Any,
    active: Any,
    half_length: float,
    half_width: float,
    is_circle: bool,
    walls: Any,
    pillars: Any,
    min_distance: Any,
    collided: Any,
    hit_arena: Any,
) -> None:
    """Fold the present poses of all worlds into their records of distance and overlap."""
    for b in range(poses.shape[0]):
        _record_world(
            b,
            poses,
            active,
            half_length,
            half_width,
            is_circle,
            walls,
            pillars,
            min_distance,
            collided,
            hit_arena,
        )


@njit(cache=True, nogil=True, parallel=True)
def advance_worlds(
    poses: Any,
    velocities: Any,
    targets: Any,
    active: Any,
    limits: Any,
    step: float,
    half_length: float,
    half_width: float,
    is_circle: bool,
    walls: Any,
    pillars: Any,
    min_distance: Any,
    collided: Any,
    hit_arena: Any,
    ray_bounds: Any,
    elapsed: float,
    ray_period: float,
    angle_min: float,
    offsets: Any,
    range_min: float,
    range_max: float,
    ranges: Any,
) -> None:
    """Advance B worlds by equal steps while their bases steer to ``targets``; worlds run in parallel.

    Args:
        poses: World-frame poses, shape (B, N, 3), updated [m, m, rad].
        velocities: Actual body twists, shape (B, N, 3), updated [m/s, m/s, rad/s].
        targets: Limited commands, shape (B, N, 3) [m/s, m/s, rad/s].
        active: Which robots exist, shape (B, N).
        limits: See ``drive_robot``.
        step: Length of one step [s].
        half_length: Footprint, see ``cast_world``.
        half_width: See ``cast_world``.
        is_circle: See ``cast_world``.
        walls: See ``cast_world``.
        pillars: See ``cast_world``.
        min_distance: Smallest distance between two centres so far, shape (B,), updated [m].
        collided: Whether two footprints have overlapped, shape (B,), updated.
        hit_arena: Whether a footprint has overlapped a wall or pillar, shape (B,), updated.
        ray_bounds: Step s measures the rays from ``ray_bounds[s]`` up to ``ray_bounds[s + 1]``, shape (S + 1,).
        elapsed: Time since ray 0 of this turn, when the first step begins [s].
        ray_period: Time between two rays [s].
        angle_min: See ``cast_world``.
        offsets: Errors of the rays' angles, shape (B, N, R) [rad].
        range_min: See ``cast_world``.
        range_max: See ``cast_world``.
        ranges: The turn being measured, shape (B, N, R), updated [m].
    """
    for b in prange(poses.shape[0]):
        before = np.empty_like(poses[b])
        for s in range(ray_bounds.shape[0] - 1):
            before[:] = poses[b]
            for i in range(poses.shape[1]):
                if active[b, i]:
                    drive_robot(poses[b, i], velocities[b, i], targets[b, i], limits, step)
            _record_world(
                b,
                poses,
                active,
                half_length,
                half_width,
                is_circle,
                walls,
                pillars,
                min_distance,
                collided,
                hit_arena,
            )
            if ray_bounds[s + 1] > ray_bounds[s]:
                cast_moving(
                    before,
                    poses[b],
                    active[b],
                    half_length,
                    half_width,
                    is_circle,
                    walls,
                    pillars,
                    angle_min,
                    offsets[b],
                    ray_bounds[s],
                    ray_bounds[s + 1],
                    (ray_bounds[s] * ray_period - (elapsed + s * step)) / step,
                    ray_period / step,
                    range_min,
                    range_max,
                    ranges[b],
                )
