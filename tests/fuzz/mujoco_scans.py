"""Campaign: what LiDARs see in random worlds of MuJoCo, against the built-in LiDAR on the same poses.

    python -m tests.fuzz.mujoco_scans --seconds 60 --seed 0

A ray along an edge, or to the end of its reach, goes either way by rounding; such rays are recognised by a second look
from a micrometre beside.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from tests.fuzz.trials import campaign, options
from tests.robots.walls import with_thick_walls
from triform.robots.mujoco import MujocoTeam
from triform.simulation import IDEAL, Arena, Footprint, World, cast_scans
from triform.types import ScanConfig

#: Largest difference of two ranges that are the same [m].
TOLERANCE = 1e-5
#: How far a second look is from the first [m].
BESIDE = 1e-6


def trial(rng: np.random.Generator) -> str:
    """Compare one random team in a random arena."""
    robots, walls, pillars = (int(count) for count in rng.integers([1, 0, 0], [9, 6, 6]))
    box = rng.random() < 0.7
    footprint = Footprint.box(*rng.uniform(0.05, 0.5, 2)) if box else Footprint.circle(rng.uniform(0.05, 0.5))
    columns = [rng.uniform(-4, 4, (pillars, 2)), rng.uniform(0.02, 0.5, (pillars, 1))]
    arena = Arena("random", rng.uniform(-4, 4, (walls, 4)), np.hstack(columns))
    reach = rng.uniform(0.5, 9)
    scan = ScanConfig(int(rng.integers(1, 700)), rng.uniform(-np.pi, np.pi), rng.uniform(0, 0.5) * reach, reach)
    profile = replace(IDEAL, footprint=footprint, lidar=replace(IDEAL.lidar, scan=scan))
    while True:
        poses = rng.uniform([-3, -3, -np.pi], [3, 3, np.pi], (1, robots, 3))
        world = World(poses, profile, arena)
        # What a LiDAR sees from within another body is not defined.
        if not world.collided[0] and not world.hit_arena[0]:
            break
    seen = MujocoTeam(poses, profile, arena, base="planar").observe().scans.ranges
    thick = with_thick_walls(arena)
    beside = [poses + [dx, dy, 0] for dx, dy in ((0, 0), (BESIDE, 0), (-BESIDE, 0), (0, BESIDE), (0, -BESIDE))]
    looks = np.stack([cast_scans(each, world.active, footprint, thick, scan) for each in beside])
    with np.errstate(invalid="ignore"):
        equal = (seen == looks) | (np.abs(seen - looks) < TOLERANCE)
    different = np.argwhere(~equal.any(axis=0))
    if len(different):
        _, robot, ray = different[0]
        return f"ray {ray} of robot {robot}: {seen[0, robot, ray]} m, built-in {looks[0, 0, robot, ray]} m"
    return ""


if __name__ == "__main__":
    chosen = options(__doc__ or "", sys.maxsize, 60.0)
    sys.exit(campaign("mujoco scans", trial, chosen.tries, chosen.seconds, chosen.seed) > 0)
