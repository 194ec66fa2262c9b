"""Campaigns: scans of random worlds of MuJoCo against the built-in LiDAR, and runs of robots that push each other.

python -m tests.fuzz.mujoco_worlds --seconds 60 --seed 0
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from tests.fuzz.trials import campaign, options
from tests.simulators.bases import on_base
from tests.simulators.walls import with_thick_walls
from triform.simulation import IDEAL, Arena, Footprint, World, cast_scans
from triform.simulation.profiles import Profile
from triform.simulators.chassis import BASES
from triform.simulators.mujoco import MujocoTeam
from triform.types import FloatArray, ScanConfig

#: Ranges that differ by less are the same [m].
TOLERANCE = 1e-5
#: A ray along an edge, or to the end of its reach, goes either way by rounding, as it does this far beside [m].
BESIDE = 1e-6
#: Solid bodies that push each other with all their force go into each other by less, on each side [m].
DEPTH = 0.01


def draw_arena(rng: np.random.Generator) -> Arena:
    """Draw up to five walls and up to five pillars."""
    walls, pillars = (int(count) for count in rng.integers(0, 6, 2))
    columns = [rng.uniform(-4, 4, (pillars, 2)), rng.uniform(0.02, 0.5, (pillars, 1))]
    return Arena("random", rng.uniform(-4, 4, (walls, 4)), np.hstack(columns))


def draw_poses(rng: np.random.Generator, robots: int, profile: Profile, arena: Arena) -> FloatArray:
    """Draw poses, shape (1, robots, 3), at which nothing overlaps."""
    while True:
        poses = rng.uniform([-3, -3, -np.pi], [3, 3, np.pi], (1, robots, 3))
        world = World(poses, profile, arena)
        if not world.collided[0] and not world.hit_arena[0]:
            return poses


def scans(rng: np.random.Generator) -> str:
    """Compare the scans of a random team in a random arena."""
    sizes, arena, reach = rng.uniform(0.05, 0.5, 2), draw_arena(rng), rng.uniform(0.5, 9)
    footprint = Footprint.box(*sizes) if rng.random() < 0.7 else Footprint.circle(sizes[0])
    scan = ScanConfig(int(rng.integers(1, 700)), rng.uniform(-np.pi, np.pi), rng.uniform(0, 0.5) * reach, reach)
    profile = replace(IDEAL, footprint=footprint, lidar=replace(IDEAL.lidar, scan=scan))
    poses = draw_poses(rng, int(rng.integers(1, 9)), profile, arena)
    seen = MujocoTeam(poses, profile, arena).observe().scans.ranges
    there = np.ones(poses.shape[:2], np.bool_)
    looks = np.stack([
        cast_scans(poses + [dx, dy, 0], there, footprint, with_thick_walls(arena), scan)
        for dx, dy in ((0, 0), (BESIDE, 0), (-BESIDE, 0), (0, BESIDE), (0, -BESIDE))
    ])  # fmt: skip
    with np.errstate(invalid="ignore"):
        equal = (seen == looks) | (np.abs(seen - looks) < TOLERANCE)
    for _, robot, ray in np.argwhere(~equal.any(axis=0)):
        return f"ray {ray} of robot {robot}: {seen[0, robot, ray]} m, built-in {looks[0, 0, robot, ray]} m"
    return ""


def runs(rng: np.random.Generator) -> str:
    """Drive a random team without any care, alone and beside another, while robots come and go."""
    arena, base, robots = draw_arena(rng), BASES[rng.integers(len(BASES))], int(rng.integers(2, 7))
    profile, start = on_base(IDEAL, base), draw_poses(rng, robots, IDEAL, arena)
    newcomer = np.array([6.0, 6.0, 0.0])
    duration = 0.1 if base == "mecanum" else 0.5
    alone = MujocoTeam(start, profile, arena, base=base)
    beside = MujocoTeam(np.concatenate([draw_poses(rng, robots, IDEAL, arena), start]), profile, arena, base=base)
    for step in range(6):
        if step == 2:
            leaving = int(rng.integers(robots))
            alone.remove_robot(0, leaving)
            beside.remove_robot(1, leaving)
        if step == 4:
            alone.add_robot(0, newcomer)
            beside.add_robot(1, newcomer)
        commands = rng.normal(0, 10 ** rng.uniform(-2, 3), alone.poses.shape)
        # The ideal base turns at any rate; corners that fly would go deep into others within one step of the physics.
        commands[..., 2] = np.clip(commands[..., 2], -3, 3)
        alone.apply(commands, duration)
        beside.apply(np.concatenate([-commands, commands]), duration)
        poses, active = alone.poses, alone.active
        if not np.isfinite(poses[active]).all():
            return f"a pose is not finite after step {step}: {poses}"
        same = [(alone.poses, beside.poses), (alone.velocities, beside.velocities)]
        same.append((alone.observe().scans.ranges, beside.observe().scans.ranges))
        if not all(np.array_equal(one[0], other[1], equal_nan=True) for one, other in same):
            return f"a run beside another is not the same to the bit after step {step}"
        smaller = Footprint.box(IDEAL.footprint.length - 2 * DEPTH, IDEAL.footprint.width - 2 * DEPTH)
        overlaps = World(poses, replace(IDEAL, footprint=smaller), arena, active=active)
        if overlaps.collided[0] or overlaps.hit_arena[0]:
            return f"bodies overlap after step {step}: {poses}"
    return ""


if __name__ == "__main__":
    chosen = options(__doc__ or "", sys.maxsize, 60.0)
    trials = {"mujoco scans": scans, "mujoco runs": runs}
    failed = [campaign(name, each, chosen.tries, chosen.seconds / 2, chosen.seed) for name, each in trials.items()]
    sys.exit(sum(failed) > 0)
