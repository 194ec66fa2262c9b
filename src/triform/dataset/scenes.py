"""Fresh views for learning the triangulating law: who stands where, what a scan shows of it, and what the law does.

Everything is in units of the prescribed distance d*, so that one policy serves all distances: a robot of 0.32 m is 0.53
long where d* is 0.6 m, and 0.21 where it is 1.5 m. Positions come from states that teams have visited, or are placed
at random; sensor, footprint, walls and pillars are drawn anew for every state.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from triform.control.triangulating import TriangulatingLaw
from triform.control.triangulating_kernels import LAW_EDGE_FEATURES, LAW_FEATURES, hidden, law_workspace, triangulate
from triform.dataset.state_buffer import StateBuffer
from triform.geometry.footprint import ROBOMASTER_EP, Footprint
from triform.kernels import kernel
from triform.perception import map_rules, map_workspace, occupied_into
from triform.simulation.cast_kernels import cast_robot, find_axes
from triform.simulation.lidar import scan_rays
from triform.simulation.ray_kernels import Scene
from triform.types import Body, FloatArray, IntArray, MapArray, MapConfig, ScanConfig, convert_fields, require

#: Robots that a view tells of, at most; any others are left out.
SEEN = 40
#: Robots whose centres are farther than this beyond the range of the LiDAR neither show nor hide a robot [d*].
_BEYOND_RANGE = 0.8
_ATTEMPTS = 10_000


@dataclass(frozen=True)
class SceneConfig:
    """What varies from state to state.

    Attributes:
        placed: Share of states that are random placements; the others come from visited states.
        sizes: Least and largest team of a random placement.
        jitter: Standard deviations of normal offsets added to visited states, one of which is drawn [d*].
        distances: Least and largest d* that a policy is meant for [m]; half of the states have 1 m.
        footprint: Usual outline of the robots.
        usual: Share of states whose robots have that outline; the others are boxes and circles.
        diameters: Least and largest diameter of these circles, and length of these boxes [m].
        rays: Numbers of rays of a LiDAR, one of which is drawn each time that views are drawn; those of the policy's
            scan if empty.
        noisy: Share of states whose ranges are noisy.
        noise: Largest standard deviation of their noise [m].
        dropping: Share of states in which rays are lost.
        dropout: Largest share of lost rays.
        walled: Share of states with a room around the team.
        pillared: Share of states with pillars.
        views: Robots of a state that look, at most.
        max_speed: Longer mean velocities are scaled to this [d*/s].
    """

    placed: float = 0.15
    sizes: tuple[int, int] = (2, 20)
    jitter: tuple[float, ...] = (0.0, 0.0, 0.005, 0.015, 0.03, 0.06)
    distances: tuple[float, float] = (0.6, 1.5)
    footprint: Footprint = ROBOMASTER_EP
    usual: float = 0.6
    diameters: tuple[float, float] = (0.1, 0.52)
    rays: tuple[int, ...] = ()
    noisy: float = 0.4
    noise: float = 0.03
    dropping: float = 0.25
    dropout: float = 0.3
    walled: float = 0.2
    pillared: float = 0.03
    views: int = 8
    max_speed: float = 0.5

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("placed", "usual", "noisy", "dropping", "dropout", "walled", "pillared"):
            value = getattr(self, name)
            require(0 <= value <= 1, f"{name} of scenes is {value}; it must lie in [0, 1]")
        require(
            1 <= self.sizes[0] <= self.sizes[1] <= 60,
            f"sizes of scenes are {self.sizes}; a least and a largest team size, of at most 60, are needed",
        )
        require(
            len(self.jitter) > 0 and all(0 <= value < np.inf for value in self.jitter),
            f"jitter of scenes is {self.jitter}; one or more finite deviations that are not negative are needed",
        )
        require(
            0 < self.distances[0] <= 1 <= self.distances[1] < np.inf,
            f"distances of scenes are {self.distances}; they must hold 1 m between them",
        )
        require(0 <= self.noise < np.inf, f"noise of scenes is {self.noise} m; it must be finite and not negative")
        require(
            0 < self.diameters[0] <= self.diameters[1] < np.inf,
            f"diameters of scenes are {self.diameters}; a least and a largest one, positive and finite, are needed",
        )
        require(min(self.rays, default=1) >= 1, f"rays of scenes are {self.rays}; each must be at least 1")
        require(self.views >= 1, f"views of scenes is {self.views}; at least 1 is needed")
        require(self.max_speed > 0, f"max_speed of scenes is {self.max_speed}; it must be positive")


@dataclass(frozen=True)
class Views:
    """What M robots see and what the law does there, all in their body frames.

    Attributes:
        maps: Occupancy maps, uint8, shape (M, H, W).
        commands: Mean velocity (x, y), turn rate (0) and amplitude of the push [d*/s, rad/s, d*/s], shape (M, 4).
        seen: The robots in sight: x, y [d*], what each adds to the velocity (2) [d*/s], whether it is a Gabriel
            neighbour and whether it shares one with this robot; the rest infinite, shape
            (M, SEEN, 2 + LAW_EDGE_FEATURES).
        features: Features of ``LawWorkspace``, shape (M, LAW_FEATURES).
    """

    maps: MapArray
    commands: FloatArray
    seen: FloatArray
    features: FloatArray


class SceneDraws(NamedTuple):
    """``SceneConfig`` as kernels take it, see there; ``outline`` is the usual one [m]."""

    placed: float
    sizes: tuple[int, int]
    jitter: FloatArray
    distances: tuple[float, float]
    usual: float
    diameters: tuple[float, float]
    outline: Body
    noisy: float
    noise: float
    dropping: float
    dropout: float
    walled: float
    pillared: float
    views: int
    max_speed: float


class BufferedStates(NamedTuple):
    """``StateBuffer`` as kernels take it.

    Attributes:
        positions: Positions of the robots of E states, one state behind the other, shape (K, 2) [d*].
        offsets: Where every state begins, and the end of the last one, shape (E + 1,).
    """

    positions: FloatArray
    offsets: IntArray


def scene_draws(config: SceneConfig) -> SceneDraws:
    """Return what varies from state to state as kernels take it."""
    values = {**vars(config), "jitter": np.array(config.jitter), "outline": config.footprint.body}
    return SceneDraws(**{name: values[name] for name in SceneDraws._fields})


def buffered_states(states: StateBuffer) -> BufferedStates:
    """Return visited states as kernels take them."""
    return BufferedStates(states.positions, states.offsets)


@kernel
def _place(rng, robots, positions):
    """Draw positions at least 0.45 apart, each robot within sight of one before it; whether all found a place."""
    side = 5.0 * np.sqrt(max(robots, 9) / 13.0) * (0.6 + 0.4 * rng.random())
    placed = 0
    for _ in range(_ATTEMPTS):
        x, y = side * rng.random(), side * rng.random()
        nearest = np.inf
        for j in range(placed):
            nearest = min(nearest, (positions[j, 0] - x) ** 2 + (positions[j, 1] - y) ** 2)
        if placed == 0 or 0.45**2 <= nearest <= 4.0:
            positions[placed, 0], positions[placed, 1] = x, y
            placed += 1
            if placed == robots:
                return True
    return False


@kernel
def draw_body(rng, draws):
    """Draw d* [m] and the outline of all robots in units of it: (d*, ``Body``)."""
    distances, outline = draws.distances, draws.outline
    distance = 1.0
    if rng.random() < 0.5:
        distance = distances[0] * (distances[1] / distances[0]) ** rng.random()
    half_length, half_width, round_ = outline.half_length, outline.half_width, outline.is_circle
    if rng.random() >= draws.usual:
        round_ = rng.random() < 0.5
        half_length = (draws.diameters[0] + (draws.diameters[1] - draws.diameters[0]) * rng.random()) / 2.0
        half_width = half_length if round_ else half_length * (0.6 + 0.4 * rng.random())
    return distance, Body(half_length / distance, half_width / distance, round_)


@kernel
def blocking_radius(body):
    """Radius of the disc for which a robot blocks sight: half its mean width."""
    return body.half_length if body.is_circle else (body.half_length + body.half_width) / 2.0


@kernel
def draw_positions(rng, visited, draws, team):
    """Write the positions of a random state into the front of ``team`` (longest, 2); returns the number of robots.

    A placement that found no place gives no robot. The states come from ``BufferedStates`` and ``SceneDraws``.
    """
    positions, offsets = visited
    sizes, jitter = draws.sizes, draws.jitter
    if offsets.shape[0] == 1 or rng.random() < draws.placed:
        robots = sizes[0] + int(rng.random() * (sizes[1] - sizes[0] + 1))
        return robots if _place(rng, robots, team) else 0
    state = int(rng.random() * (offsets.shape[0] - 1))
    robots = offsets[state + 1] - offsets[state]
    deviation = jitter[int(rng.random() * jitter.shape[0])]
    for k in range(robots):
        for axis in range(2):
            team[k, axis] = positions[offsets[state] + k, axis] + deviation * rng.standard_normal()
    return robots


@kernel
def longest_team(visited, draws):
    """Robots of the largest team that ``draw_positions`` can write."""
    offsets, longest = visited.offsets, draws.sizes[1]
    for e in range(offsets.shape[0] - 1):
        longest = max(longest, offsets[e + 1] - offsets[e])
    return longest


@kernel
def _draw_room(rng, positions, walls):
    """Write the four walls of a room of random orientation around ``positions`` (N, 2), 0.25 to 2.25 from them."""
    angle = np.pi * rng.random()
    cos, sin = np.cos(angle), np.sin(angle)
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for k in range(positions.shape[0]):
        a = cos * positions[k, 0] + sin * positions[k, 1]
        b = cos * positions[k, 1] - sin * positions[k, 0]
        low_x, high_x, low_y, high_y = min(low_x, a), max(high_x, a), min(low_y, b), max(high_y, b)
    low_x -= 0.25 + 2.0 * rng.random()
    low_y -= 0.25 + 2.0 * rng.random()
    high_x += 0.25 + 2.0 * rng.random()
    high_y += 0.25 + 2.0 * rng.random()
    corners = ((low_x, low_y), (high_x, low_y), (high_x, high_y), (low_x, high_y))
    for k in range(4):
        for end in range(2):
            a, b = corners[(k + end) % 4]
            walls[k, 2 * end] = cos * a - sin * b
            walls[k, 2 * end + 1] = sin * a + cos * b


@kernel
def _draw_pillar(rng, positions, pillar):
    """Write one pillar of 0.1 to 0.4 radius near ``positions`` but clear of them by 0.3; whether it found a place."""
    robot = int(rng.random() * positions.shape[0])
    angle, away = 2.0 * np.pi * rng.random(), 0.6 + 1.6 * rng.random()
    pillar[0] = positions[robot, 0] + away * np.cos(angle)
    pillar[1] = positions[robot, 1] + away * np.sin(angle)
    pillar[2] = 0.1 + 0.3 * rng.random()
    for k in range(positions.shape[0]):
        if (positions[k, 0] - pillar[0]) ** 2 + (positions[k, 1] - pillar[1]) ** 2 < (pillar[2] + 0.3) ** 2:
            return False
    return True


@kernel
def label_robot(positions, i, heading, law, blocking, reach, max_speed, workspace, command, seen):
    """Write what the law does for robot i and what it sees, in its body frame; arguments as ``Views`` has them.

    ``reach`` is the range of its LiDAR [d*]. The features of the robot are those of the workspace afterwards.
    """
    x, y, all_x, all_y = workspace.x, workspace.y, workspace.all_x, workspace.all_y
    # A robot is seen as long as its near side is within range.
    sight = min(law.sight, reach + 0.7 * blocking)
    cos, sin = np.cos(heading), np.sin(heading)
    all_x[0] = all_y[0] = x[0] = y[0] = 0.0
    near = 1
    for j in range(positions.shape[0]):
        d_x, d_y = positions[j, 0] - positions[i, 0], positions[j, 1] - positions[i, 1]
        if j != i and d_x * d_x + d_y * d_y <= sight * sight:
            all_x[near], all_y[near] = cos * d_x + sin * d_y, cos * d_y - sin * d_x
            near += 1
    count = 1
    for k in range(1, near):
        if not hidden(all_x, all_y, near, k, blocking):
            x[count], y[count] = all_x[k], all_y[k]
            count += 1
    v_x, v_y, push = triangulate(count, law, workspace)
    speed = np.sqrt(v_x * v_x + v_y * v_y)
    scale = max_speed / speed if speed > max_speed else 1.0
    command[0], command[1], command[2], command[3] = scale * v_x, scale * v_y, 0.0, push
    seen[:] = np.inf
    for k in range(1, min(count, seen.shape[0] + 1)):
        seen[k - 1, 0], seen[k - 1, 1] = x[k], y[k]
        for c in range(LAW_EDGE_FEATURES):
            seen[k - 1, 2 + c] = workspace.edge_features[k, c]


@kernel
def _draw_views(rng, visited, draws, law, scan, rules, maps, commands, seen, features):
    """Fill ``maps``, ``commands``, ``seen`` and ``features`` of ``Views``; other arguments as ``draw_views``."""
    size = maps.shape[1]
    cos_rays, sin_rays = scan.cos, scan.sin
    noise, noisy, dropout, dropping = draws.noise, draws.noisy, draws.dropout, draws.dropping
    longest = longest_team(visited, draws)
    team = np.empty((longest, 2))
    poses, axes = np.empty((longest, 3)), np.empty((longest, 2))
    active = np.ones(longest, dtype=np.bool_)
    workspace = law_workspace(longest)
    ranges = np.empty(cos_rays.shape[0])
    walls, pillars = np.empty((4, 4)), np.empty((1, 3))
    at_rest = np.zeros(3)
    map_memory = map_workspace(size)
    cells = map_memory.cells
    farthest = scan.range_max + _BEYOND_RANGE
    m = 0
    while m < maps.shape[0]:
        robots = draw_positions(rng, visited, draws, team)
        if robots == 0:
            continue
        positions = team[:robots]
        distance, body = draw_body(rng, draws)
        blocking = blocking_radius(body)
        sigma = noise * rng.random() / distance if rng.random() < noisy else 0.0
        lost = dropout * rng.random() if rng.random() < dropping else 0.0
        wall_count = pillar_count = 0
        if rng.random() < draws.walled:
            _draw_room(rng, positions, walls)
            wall_count = 4
        if rng.random() < draws.pillared and _draw_pillar(rng, positions, pillars[0]):
            pillar_count = 1
        first = int(rng.random() * robots)
        for view in range(min(draws.views, robots, maps.shape[0] - m)):
            i = (first + view) % robots
            # Who is too far to matter is left out; the robot that looks stands in row 0.
            near = 1
            poses[0, 0], poses[0, 1] = positions[i, 0], positions[i, 1]
            for j in range(robots):
                d_x, d_y = positions[j, 0] - positions[i, 0], positions[j, 1] - positions[i, 1]
                if j != i and d_x * d_x + d_y * d_y < farthest * farthest:
                    poses[near, 0], poses[near, 1] = positions[j, 0], positions[j, 1]
                    near += 1
            for k in range(near):
                poses[k, 2] = (2.0 * rng.random() - 1.0) * np.pi
            find_axes(poses[:near], axes)
            scene = Scene(body, walls[:wall_count], pillars[:pillar_count])
            cast_robot(0, poses[:near], active[:near], scene, scan, axes, ranges)
            for k in range(ranges.shape[0]):
                if sigma > 0.0 and np.isfinite(ranges[k]):
                    ranges[k] += sigma * rng.standard_normal()
                if lost > 0.0 and rng.random() < lost:
                    ranges[k] = np.nan
            kept = occupied_into(ranges, at_rest, cos_rays, sin_rays, rules, map_memory)
            for q in range(kept):
                maps[m, cells[q] // size, cells[q] % size] = 1
            label_robot(
                poses[:near], 0, poses[0, 2], law, blocking, scan.range_max, draws.max_speed, workspace, commands[m],
                seen[m],
            )  # fmt: skip
            features[m] = workspace.features
            m += 1


def draw_views(
    rng: np.random.Generator,
    maps: int,
    law: TriangulatingLaw,
    config: SceneConfig,
    visited: StateBuffer,
    scan: ScanConfig,
    map_config: MapConfig,
) -> Views:
    """Draw views of random robots in random states.

    Args:
        rng: Source of all randomness; the views are a function of its state alone.
        maps: Views wanted, M.
        law: Labels them.
        config: What varies.
        visited: States to draw from; without any, all states are random placements.
        scan: The LiDAR, lengths in units of d*.
        map_config: The occupancy map, lengths in units of d*.
    """
    size = map_config.size
    if config.rays:
        scan = replace(scan, rays=int(rng.choice(np.array(config.rays))))
    out = Views(
        np.zeros((maps, size, size), dtype=np.uint8),
        np.empty((maps, 4)),
        np.empty((maps, SEEN, 2 + LAW_EDGE_FEATURES)),
        np.empty((maps, LAW_FEATURES)),
    )
    _draw_views(
        rng, buffered_states(visited), scene_draws(config), law.constants, scan_rays(scan), map_rules(scan, map_config),
        out.maps, out.commands, out.seen, out.features,
    )  # fmt: skip
    return out
