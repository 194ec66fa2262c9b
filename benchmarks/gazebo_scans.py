"""How far Gazebo's ranges are from those of the built-in LiDAR on the same poses, as a table.

python -m benchmarks.gazebo_scans
"""

from __future__ import annotations

import numpy as np

from triform.simulation import IDEAL, World, cast_scans, get_arena
from triform.simulators.gazebo import GazeboServer, State
from triform.types import FloatArray

ROBOTS, PLACEMENTS = 8, 100
ARENA = get_arena("pillars")
QUANTILES = (0.5, 0.99, 0.999, 1.0)


def scatter(rng: np.random.Generator) -> FloatArray:
    """Poses of a team in the middle of the arena that touches nothing, shape (ROBOTS, 3)."""
    while True:
        poses = rng.uniform([-2.5, -2.5, -np.pi], [2.5, 2.5, np.pi], (ROBOTS, 3))
        world = World(poses[None], IDEAL, ARENA)
        if world.min_distance[0] > 0.5 and not world.hit_arena[0]:
            return poses


def differences(state: State) -> FloatArray:
    """Differences of all ranges [m]; ``inf`` where one hits and the other does not."""
    assert state.ranges is not None
    expected = cast_scans(state.poses[None], state.active[None], IDEAL.footprint, ARENA, IDEAL.lidar.scan)[0]
    both = np.isfinite(expected) & np.isfinite(state.ranges)
    same = ~np.isfinite(expected) & (state.ranges == expected)
    return np.where(same, 0.0, np.abs(np.subtract(state.ranges, expected, where=both, out=np.full(both.shape, np.inf))))


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    rest, moving = [], []
    with GazeboServer(IDEAL, ARENA, ROBOTS) as server:
        for _ in range(PLACEMENTS):
            rest.append(differences(server.reset(scatter(rng), scan=True)))
            commands = rng.uniform([-0.3, -0.3, -1.0], [0.3, 0.3, 1.0], (ROBOTS, 3))
            moving.append(differences(server.step(commands, 50)))
    print(
        "| | rays | median | 99 % | 99.9 % | largest | hit in one, miss in the other |\n|---|---|---|---|---|---|---|"
    )
    for name, found in (("at rest", rest), ("after 0.5 s of random commands", moving)):
        each = np.concatenate(found).ravel()
        hit = each[np.isfinite(each)]
        cells = [f"{1e3 * quantile:.2g} mm" for quantile in np.quantile(hit[hit > 0], QUANTILES)]
        print(f"| {name} | {len(each)} | {' | '.join(cells)} | {len(each) - len(hit)} |")


if __name__ == "__main__":
    main()
