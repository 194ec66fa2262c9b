"""Fresh demonstrations: states drawn anew for every batch, with the teacher's command for each robot.

A state is a random placement, a placement that the teacher has moved for a random time, or one that it has moved long
enough to be near equilibrium; the moved ones are jittered, so that the learner also sees how to come back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from triform.control import Teacher, expert_into
from triform.dataset.neighbours import COLUMNS, neighbours_into
from triform.geometry.footprint import ROBOMASTER_EP, Footprint
from triform.kernels import kernel
from triform.perception import map_rules, map_workspace, occupied_into
from triform.simulation import Arena, is_connected
from triform.simulation.lidar import cast_world, scan_rays
from triform.simulation.ray_kernels import Scene
from triform.types import (
    SENSING_RANGE,
    FloatArray,
    MapArray,
    MapConfig,
    ScanConfig,
    TriformError,
    convert_fields,
    require,
)

#: Placements drawn before giving up.
_ATTEMPTS = 1_000_000


@dataclass(frozen=True)
class StateConfig:
    """Which states are drawn.

    Attributes:
        robots: Team sizes; one is drawn for each batch.
        side: Side of the square in which robots are placed [m].
        min_spacing: Least distance of two centres when placed [m].
        moved: Share of states that the teacher has moved for up to ``moved_time``.
        settled: Share of states that it has moved for up to ``settled_time``.
        moved_time: Longest drive of a moved state [s].
        settled_time: Longest drive of a settled state [s].
        moved_jitter: Standard deviations [m], one of which is drawn for a moved state.
        settled_jitter: The same for settled states.
        max_speed: Speed limit of the drive [m/s].
    """

    robots: tuple[int, ...] = tuple(range(1, 14))
    side: float = 5.0
    min_spacing: float = 0.45
    moved: float = 0.4
    settled: float = 0.3
    moved_time: float = 8.0
    settled_time: float = 20.0
    moved_jitter: tuple[float, ...] = (0.0, 0.02, 0.1)
    settled_jitter: tuple[float, ...] = (0.0, 0.01, 0.03, 0.05, 0.1)
    max_speed: float = 0.5

    def __post_init__(self) -> None:
        convert_fields(self)
        require(
            len(self.robots) > 0 and min(self.robots) >= 1, f"team sizes are {self.robots}; each must be at least 1"
        )
        require(
            self.moved >= 0 and self.settled >= 0 and self.moved + self.settled <= 1,
            f"shares moved {self.moved} and settled {self.settled} must not be negative nor sum to more than 1",
        )
        for name in ("side", "moved_time", "settled_time", "max_speed"):
            value = getattr(self, name)
            require(0 < value < np.inf, f"{name} of states is {value}; it must be positive and finite")
        for name in ("moved_jitter", "settled_jitter"):
            values = getattr(self, name)
            require(
                len(values) > 0 and all(0 <= value < np.inf for value in values),
                f"{name} of states is {values}; one or more finite deviations that are not negative are needed",
            )
        # Placements are drawn until they fit: robots that cover a quarter of the square would take for ever.
        crowd = max(self.robots) * np.pi * self.min_spacing**2 / 4
        require(
            self.min_spacing >= 0 and crowd <= self.side**2 / 4,
            f"{max(self.robots)} robots {self.min_spacing} m apart do not fit well into a square of {self.side} m",
        )


@dataclass(frozen=True)
class FreshBatch:
    """Demonstrations of E records of N robots, flattened to M = E * N maps.

    Attributes:
        maps: Occupancy maps, uint8, shape (M, H, W).
        commands: The teacher's body twists [m/s, m/s, rad/s], shape (M, 3).
        neighbours: The other robots in the body frame, see ``neighbours_into``, shape (M, N - 1, COLUMNS).
    """

    maps: MapArray
    commands: FloatArray
    neighbours: FloatArray


@kernel
def _place(rng, side, min_spacing, poses):
    """Draw uniform poses until no two are too close and all hang together within the sensing range, if they ever do."""
    robots = poses.shape[0]
    for _ in range(_ATTEMPTS):
        fits = True
        for i in range(robots):
            poses[i, 0] = rng.random() * side
            poses[i, 1] = rng.random() * side
            poses[i, 2] = (2.0 * rng.random() - 1.0) * np.pi
            for j in range(i):
                if (poses[i, 0] - poses[j, 0]) ** 2 + (poses[i, 1] - poses[j, 1]) ** 2 < min_spacing**2:
                    fits = False
                    break
            if not fits:
                break
        if fits and is_connected(poses, SENSING_RANGE):
            return True
    return False


@kernel
def _drive(poses, active, duration, step, springs, graph, twists):
    """Let the teacher move the robots for a while; headings stay, as its turn rate is zero."""
    for _ in range(int(duration / step)):
        expert_into(poses, active, springs, graph, twists)
        for i in range(poses.shape[0]):
            cos, sin = np.cos(poses[i, 2]), np.sin(poses[i, 2])
            poses[i, 0] += step * (cos * twists[i, 0] - sin * twists[i, 1])
            poses[i, 1] += step * (sin * twists[i, 0] + cos * twists[i, 1])


class _Draws(NamedTuple):
    """``StateConfig`` as kernels take it; see there."""

    side: float
    min_spacing: float
    moved: float
    settled: float
    moved_time: float
    settled_time: float
    moved_jitter: FloatArray
    settled_jitter: FloatArray


@kernel
def _draw_records(rng, draws, driving, labelling, scene, scan, rules, maps, commands, neighbours):
    """Fill ``maps``, ``commands`` and ``neighbours`` of ``FreshBatch``; whether every placement was found.

    Robots have moved by the springs ``driving``, and the springs ``labelling`` command them.
    """
    records, robots, size = maps.shape[0], maps.shape[1], maps.shape[2]
    moved, settled, moved_jitter, settled_jitter = draws.moved, draws.settled, draws.moved_jitter, draws.settled_jitter
    cos_rays, sin_rays = scan.cos, scan.sin
    poses = np.empty((robots, 3))
    twists = np.empty((robots, 3))
    active = np.ones(robots, dtype=np.bool_)
    graph = np.empty((robots, robots), dtype=np.bool_)
    ranges = np.empty((robots, cos_rays.shape[0]))
    axes = np.empty((robots, 2))
    workspace = map_workspace(size)
    cells = workspace.cells
    at_rest = np.zeros(3)
    for e in range(records):
        if not _place(rng, draws.side, draws.min_spacing, poses):
            return False
        kind = rng.random()
        duration, jitter = 0.0, 0.0
        if kind < moved:
            duration = rng.random() * draws.moved_time
            jitter = moved_jitter[int(rng.random() * moved_jitter.shape[0])]
        elif kind < moved + settled:
            duration = rng.random() * draws.settled_time
            jitter = settled_jitter[int(rng.random() * settled_jitter.shape[0])]
        _drive(poses, active, duration, 0.1, driving, graph, twists)
        if jitter > 0.0:
            for i in range(robots):
                poses[i, 0] += jitter * rng.standard_normal()
                poses[i, 1] += jitter * rng.standard_normal()
        expert_into(poses, active, labelling, graph, twists)
        commands[e] = twists
        cast_world(poses, active, scene, scan, axes, ranges)
        for i in range(robots):
            kept = occupied_into(ranges[i], at_rest, cos_rays, sin_rays, rules, workspace)
            for q in range(kept):
                maps[e, i, cells[q] // size, cells[q] % size] = 1
        neighbours_into(poses, graph, labelling.distance, labelling.odd_gain, neighbours[e])
    return True


def draw_fresh(
    rng: np.random.Generator,
    maps: int,
    teacher: Teacher,
    states: StateConfig,
    scan: ScanConfig,
    map_config: MapConfig,
    footprint: Footprint = ROBOMASTER_EP,
) -> FreshBatch:
    """Draw a batch of about ``maps`` demonstrations (a whole number of records of one team size).

    Args:
        rng: Source of all randomness; the batch is a function of its state alone.
        maps: Maps wanted.
        teacher: Who labels the states, and who moves the robots before.
        states: Which states are drawn.
        scan: The LiDAR.
        map_config: The occupancy map.
        footprint: Shape of every robot.

    Raises:
        TriformError: If no placement of the robots turns up in the square.
    """
    robots = int(rng.choice(np.array(states.robots)))
    records = max(1, round(maps / robots))
    size = map_config.size
    batch_maps = np.zeros((records, robots, size, size), dtype=np.uint8)
    commands = np.empty((records, robots, 3))
    neighbours = np.empty((records, robots, robots - 1, COLUMNS))
    values = {name: getattr(states, name) for name in _Draws._fields}
    jitters = {name: np.array(values[name]) for name in ("moved_jitter", "settled_jitter")}
    draws = _Draws(**(values | jitters))
    labelling, arena = teacher.springs, Arena.open()
    driving = labelling._replace(max_speed=min(states.max_speed, teacher.max_speed))
    scene, rules = Scene(footprint.body, arena.walls, arena.pillars), map_rules(scan, map_config)
    placed = _draw_records(
        rng, draws, driving, labelling, scene, scan_rays(scan), rules, batch_maps, commands, neighbours
    )
    if not placed:
        raise TriformError(
            f"no placement of {robots} robots at least {states.min_spacing} m apart and linked within "
            f"{SENSING_RANGE} m turned up in a square of {states.side} m"
        )
    return FreshBatch(
        batch_maps.reshape(-1, size, size),
        commands.reshape(-1, 3),
        neighbours.reshape(records * robots, robots - 1, COLUMNS),
    )
