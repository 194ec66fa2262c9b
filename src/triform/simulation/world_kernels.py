"""Compiled advance of batched worlds: drive, record contacts, measure the rays that fall due."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from triform.geometry.cells import pairs_within, smallest_distance_of, squared_distance
from triform.kernels import kernel
from triform.simulation.body_kernels import body_reach
from triform.simulation.contact_kernels import any_hits_arena, robots_overlap
from triform.simulation.drive_kernels import drive_team
from triform.simulation.moving_ray_kernels import DueRays, cast_moving, list_near, seen_within
from triform.simulation.ray_kernels import ScanRays


class Motion(NamedTuple):
    """How the robots of all worlds move.

    Attributes:
        poses: World-frame poses, shape (B, N, 3) [m, m, rad].
        velocities: Actual body twists, shape (B, N, 3) [m/s, m/s, rad/s].
        targets: Limited commands, shape (B, N, 3) [m/s, m/s, rad/s].
        active: Which robots exist, shape (B, N).
        kinds: First robot of each kind, see ``drive_team``.
        limits: Of the drive of each kind, see ``drive_team``.
        step: Length of one integration step [s].
        casts: Whether a LiDAR measures meanwhile.
    """

    poses: Any
    velocities: Any
    targets: Any
    active: Any
    kinds: Any
    limits: Any
    step: float
    casts: bool


class Contacts(NamedTuple):
    """What has come of the robots' closeness so far.

    Attributes:
        min_distance: Smallest distance between two centres, shape (B,) [m].
        collided: Whether two footprints have overlapped, shape (B,).
        hit_arena: Whether a footprint has overlapped a wall or pillar, shape (B,).
    """

    min_distance: Any
    collided: Any
    hit_arena: Any


class LidarTurn(NamedTuple):
    """The turn that the LiDARs of one kind of robots are measuring in all worlds.

    Attributes:
        robot: The first of these M robots; the others follow it.
        ray_bounds: Integration step s measures the rays from ``ray_bounds[s]`` up to ``ray_bounds[s + 1]``, shape
            (S + 1,).
        elapsed: Time since ray 0 of this turn, when the first step begins [s].
        ray_period: Time between two rays [s].
        scan: Rays and limits of range.
        offsets: Errors of the rays' angles, shape (B, M, R) [rad], or (B, M, 0) for none.
        ranges: The turn, shape (B, M, R) [m].
        hits: What its rays hit, see ``cast_moving``, shape (B, M, R), or (B, M, 0) if not asked for.
    """

    robot: int
    ray_bounds: Any
    elapsed: float
    ray_period: float
    scan: ScanRays
    offsets: Any
    ranges: Any
    hits: Any


@kernel
def _record_pairs(poses: Any, pairs: Any, body: Any, min_distance: float, collided: bool) -> tuple[float, bool]:
    """Fold pairs of robots into the smallest distance [m] and whether two footprints have overlapped."""
    squared = math.inf
    for pair in range(pairs.shape[0]):
        squared = min(squared, squared_distance(poses, pairs[pair, 0], pairs[pair, 1]))
    if not collided and squared < 4 * body_reach(body) ** 2:
        for pair in range(pairs.shape[0]):
            if robots_overlap(poses, pairs[pair, 0], pairs[pair, 1], body):
                collided = True
                break
    return min(min_distance, math.sqrt(squared)), collided


@kernel
def record_contacts(poses: Any, active: Any, scene: Any, contacts: Any, first: int, last: int) -> None:
    """Fold the present poses (B, N, 3) of the worlds ``first <= b < last`` into their ``Contacts``."""
    body = scene.body
    min_distance, collided, hit_arena = contacts
    for b in range(first, last):
        min_distance[b] = min(min_distance[b], smallest_distance_of(poses[b], active[b]))
        if not collided[b]:
            pairs = pairs_within(poses[b], active[b], 4 * body_reach(body) ** 2)
            _, collided[b] = _record_pairs(poses[b], pairs, body, math.inf, False)
        if not hit_arena[b]:
            hit_arena[b] = any_hits_arena(poses[b], active[b], scene)


@kernel
def _longest_travel(velocities: Any, targets: Any, active: Any, duration: float) -> float:
    """Distance that no robot of one world can exceed in ``duration`` [s] while it steers to its target [m]."""
    speed = 0.0
    for i in range(active.shape[0]):
        if active[i]:
            speed = max(speed, math.hypot(velocities[i, 0], velocities[i, 1]), math.hypot(targets[i, 0], targets[i, 1]))
    return speed * duration


@kernel
def _close_pairs(poses: Any, active: Any, body: Any, min_distance: float, collided: bool, travel: float) -> Any:
    """Pairs that can lower the smallest distance, or be the first to overlap, before each has gone ``travel`` [m]."""
    reach = min_distance if collided else max(min_distance, 2 * body_reach(body))
    # Without a pair so far there is no smallest distance and none will come.
    reach = (reach + 2 * travel) * (1 + 1e-9) if reach < math.inf else 0.0
    return pairs_within(poses, active, reach * reach)


@kernel
def _advance_world(b: int, motion: Any, scene: Any, contacts: Any, turns: Any) -> None:
    """Advance world b, see ``advance_worlds``."""
    poses, velocities, targets, active = motion.poses[b], motion.velocities[b], motion.targets[b], motion.active[b]
    min_distance, collided, hit_arena = contacts.min_distance[b], contacts.collided[b], contacts.hit_arena[b]
    body, step, steps = scene.body, motion.step, turns[0].ray_bounds.shape[0] - 1
    travel = _longest_travel(velocities, targets, active, steps * step)
    pairs = _close_pairs(poses, active, body, min_distance, collided, travel)
    near = (np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))
    if motion.casts:
        sight = 0.0
        for turn in turns:
            sight = max(sight, seen_within(body, turn.scan, travel))
        near = list_near(poses, active, sight)
    before = np.empty_like(poses)
    for s in range(steps):
        if motion.casts:
            before[:] = poses
        drive_team(poses, velocities, targets, active, motion.kinds, motion.limits, step)
        min_distance, collided = _record_pairs(poses, pairs, body, min_distance, collided)
        if not hit_arena:
            hit_arena = any_hits_arena(poses, active, scene)
        if not motion.casts:
            continue
        for turn in turns:
            first, last = turn.ray_bounds[s], turn.ray_bounds[s + 1]
            if last > first:
                first_share = (first * turn.ray_period - (turn.elapsed + s * step)) / step
                due = DueRays(turn.robot, first, last, first_share, turn.ray_period / step)
                measured = turn.ranges[b], turn.hits[b]
                cast_moving(before, poses, active, near, scene, turn.scan, turn.offsets[b], due, *measured)
    contacts.min_distance[b], contacts.collided[b], contacts.hit_arena[b] = min_distance, collided, hit_arena


@kernel
def advance_worlds(motion: Any, scene: Any, contacts: Any, turns: Any, first: int, last: int) -> None:
    """Advance the worlds ``first <= b < last`` by equal steps while their bases steer to their targets.

    Who may come close to whom, or see whom, is found once, with an allowance for the way all go meanwhile.

    Args:
        motion: ``Motion``; poses and velocities are updated.
        scene: ``Scene``.
        contacts: ``Contacts``, updated.
        turns: A tuple with the ``LidarTurn`` of each kind of robots; ranges are updated.
        first: First world to advance.
        last: One past the last world to advance.
    """
    for b in range(first, last):
        _advance_world(b, motion, scene, contacts, turns)
