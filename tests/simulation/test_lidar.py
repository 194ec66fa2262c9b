"""Ray casting against Shapely and against a slow oracle, and the sensor's errors."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from triform.simulation import (
    ROBOMASTER_EP,
    Arena,
    Footprint,
    LidarConfig,
    NoiseBand,
    angle_offsets,
    apply_noise,
    cast_rolling,
    cast_scans,
    cast_world,
    constant_noise,
    noise_sigma,
    sample_starts,
)
from triform.simulation.lidar import scan_rays
from triform.simulation.ray_kernels import Scene
from triform.types import ConfigurationError, ScanConfig

Array = NDArray[np.float64]
CONFIG = ScanConfig(rays=450, range_min=0.02, range_max=2.0)
DISC = Footprint.circle(0.3)
Outlines = Footprint | tuple[Footprint, ...]
#: Outlines of the robots of a mixed team.
MIXED = (DISC, ROBOMASTER_EP, Footprint.box(0.15, 0.5), DISC, Footprint.circle(0.6), ROBOMASTER_EP, DISC)


def _box(pose: Array, footprint: Footprint) -> Polygon:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return Polygon(footprint.corners @ np.array([[cos, sin], [-sin, cos]]) + pose[:2])


def _circle_distance(origin: Array, direction: Array, center: Array, radius: float) -> tuple[float, bool]:
    """Smaller root of |o + t d - c|^2 = r^2, and whether the ray is too close to a tangent to be compared."""
    rest = origin - center
    if rest @ rest <= radius**2:
        return 0.0, False
    half, constant = rest @ direction, rest @ rest - radius**2
    discriminant = half**2 - constant
    if discriminant < 0 or half > 0:
        return np.inf, abs(discriminant) < 1e-7
    return -half - np.sqrt(discriminant), discriminant < 1e-7


def _limited(distance: float, config: ScanConfig) -> float:
    if distance > config.range_max:
        return np.inf
    return -np.inf if distance < config.range_min else distance


def _oracle(
    poses: Array, active: Array, observer: int, angle: float, outlines: Outlines, arena: Arena, config: ScanConfig
) -> tuple[float, bool]:
    """Range of one ray at a world-frame angle by Shapely, and whether it may not be compared (grazes an end)."""
    origin, direction = poses[observer, :2], np.array([np.cos(angle), np.sin(angle)])
    ray = LineString([origin, origin + 20 * direction])
    solids: list[BaseGeometry] = [LineString(wall.reshape(2, 2)) for wall in arena.walls]
    circles = [(pillar[:2], pillar[2]) for pillar in arena.pillars]
    for j in np.flatnonzero(active):
        footprint = outlines[j] if isinstance(outlines, tuple) else outlines
        if j != observer and footprint.is_circle:
            circles.append((poses[j, :2], footprint.half_length))
        elif j != observer:
            solids.append(_box(poses[j], footprint))
    nearest, grazes = np.inf, False
    for solid in solids:
        ends = solid.exterior.coords if isinstance(solid, Polygon) else solid.coords
        grazes |= any(ray.distance(Point(end)) < 1e-9 for end in ends)
        if ray.intersects(solid):
            nearest = min(nearest, Point(origin).distance(ray.intersection(solid)))
    for center, radius in circles:
        distance, tangent = _circle_distance(origin, direction, center, radius)
        nearest, grazes = min(nearest, distance), grazes or tangent
    near_limit = min(abs(nearest - config.range_max), abs(nearest - config.range_min)) < 1e-9
    return _limited(nearest, config), grazes or near_limit


def _scene(rng: np.random.Generator) -> Arena:
    walls = rng.uniform(-3, 3, (3, 4))
    return Arena("scene", walls, np.column_stack([rng.uniform(-3, 3, (2, 2)), rng.uniform(0.05, 0.4, 2)]))


def _check(ranges: float, expected: float) -> None:
    if np.isfinite(expected):
        assert ranges == pytest.approx(expected, abs=1e-9)
    else:
        assert ranges == expected


@pytest.mark.parametrize("footprint", [ROBOMASTER_EP, DISC, MIXED], ids=["box", "circle", "mixed"])
@pytest.mark.parametrize("scene", range(6))
def test_random_scenes_match_shapely(scene: int, footprint: Outlines) -> None:
    rng = np.random.default_rng([scene, footprint == DISC])
    robots = 7
    poses = rng.uniform([-2, -2, -np.pi], [2, 2, np.pi], (1, robots, 3))
    active = rng.random((1, robots)) < 0.85
    active[0, 0] = True
    arena = _scene(rng) if scene % 2 else Arena.open()
    config = ScanConfig(rays=119, angle_min=rng.uniform(-4, 4), range_min=0.1, range_max=2.5)
    ranges = cast_scans(poses, active, footprint, arena, config)
    compared = 0
    for i in range(robots):
        if not active[0, i]:
            assert np.all(ranges[0, i] == np.inf)
            continue
        for k, angle in enumerate(config.angles):
            expected, grazes = _oracle(poses[0], active[0], i, poses[0, i, 2] + angle, footprint, arena, config)
            if not grazes:
                _check(ranges[0, i, k], expected)
                compared += 1
    assert compared > 100


@pytest.mark.parametrize("footprint", [ROBOMASTER_EP, DISC, MIXED[:5]], ids=["box", "circle", "mixed"])
def test_rolling_turn_with_angle_errors_matches_a_slow_oracle(footprint: Outlines) -> None:
    rng = np.random.default_rng(5)
    robots, config = 5, ScanConfig(rays=211, range_min=0.1, range_max=3.0)
    start = rng.uniform([-1.5, -1.5, -np.pi], [1.5, 1.5, np.pi], (1, robots, 3))
    end = start + rng.uniform(-0.3, 0.3, start.shape)
    active = np.ones((1, robots), dtype=bool)
    offsets = rng.normal(0, 0.01, (1, robots, config.rays))
    arena = _scene(rng)
    ranges = cast_rolling(start, end, active, footprint, arena, config, offsets)
    for i, k in itertools.product(range(robots), range(config.rays)):
        poses = start[0] + k / config.rays * (end[0] - start[0])
        angle = poses[i, 2] + config.angles[k] + offsets[0, i, k]
        expected, grazes = _oracle(poses, active[0], i, angle, footprint, arena, config)
        if not grazes:
            _check(ranges[0, i, k], expected)


@pytest.mark.parametrize("large", [False, True])
def test_some_robots_measure_what_they_measure_among_all(large: bool) -> None:
    """Of a large team too, which is cast by cells, and ray by ray with errors of angle."""
    rng, robots = np.random.default_rng(6), 40 if large else 7
    poses = rng.uniform([-2, -2, -np.pi], [2, 2, np.pi], (2, robots, 3))
    outlines = tuple(itertools.islice(itertools.cycle(MIXED), robots))
    scene, some = (outlines, _scene(rng), CONFIG), slice(2, 5)
    everyone = np.ones((2, robots), dtype=bool)
    whole = cast_scans(poses, everyone, *scene)
    np.testing.assert_array_equal(cast_scans(poses, everyone, *scene, robots=some), whole[:, some])
    nothing = np.zeros((2, 3, CONFIG.rays))
    by_ray = cast_rolling(poses, poses, everyone, *scene, nothing, robots=some)
    finite = np.isfinite(whole[:, some]) & np.isfinite(by_ray)
    np.testing.assert_allclose(by_ray[finite], whole[:, some][finite], atol=1e-9)
    assert finite.mean() > 0.99 * np.isfinite(whole[:, some]).mean() > 0.1
    with pytest.raises(ConfigurationError, match="2 footprints given for"):
        cast_scans(poses, everyone, MIXED[:2], *scene[1:])


def test_headings_of_a_rolling_turn_take_the_shorter_way() -> None:
    config = ScanConfig(rays=4, angle_min=0.0, range_max=5.0)
    wall = Arena("wall", np.array([[-3.0, -9.0, -3.0, 9.0]]))
    start, end = np.array([[[0.0, 0.0, np.pi - 0.1]]]), np.array([[[0.0, 0.0, -np.pi + 0.1]]])
    ranges = cast_rolling(start, end, np.ones((1, 1), dtype=bool), DISC, wall, config)
    assert ranges[0, 0, 0] == pytest.approx(3 / np.cos(0.1), abs=1e-12)
    # Ray 2 points backwards, half-way through the turn at heading pi: exactly away from the wall.
    assert ranges[0, 0, 2] == np.inf


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10**6), circle=st.booleans(), rays=st.integers(1, 500))
def test_ray_by_ray_equals_by_interval(seed: int, circle: bool, rays: int) -> None:
    rng = np.random.default_rng(seed)
    footprint = DISC if circle else ROBOMASTER_EP
    poses = rng.uniform([-2, -2, -9], [2, 2, 9], (2, 6, 3))
    active = rng.random((2, 6)) < 0.8
    config = ScanConfig(rays=rays, angle_min=rng.uniform(-9, 9), range_min=0.2, range_max=2.0)
    arena = _scene(rng)
    by_interval = cast_scans(poses, active, footprint, arena, config)
    by_ray = cast_rolling(poses, poses, active, footprint, arena, config)
    with np.errstate(invalid="ignore"):
        differs = ~((by_interval == by_ray) | (np.abs(by_interval - by_ray) < 1e-7))
    assert differs.sum() == 0


def test_no_ray_is_lost_where_two_sides_meet() -> None:
    """Corners, tangents and sides exactly on rays: a square straight ahead, turned by 45 degrees."""
    square = Footprint.box(0.4, 0.4)
    for rays in (4, 8, 360, 450):
        config = ScanConfig(rays=rays, angle_min=-np.pi, range_max=2.0)
        for bearing in 2 * np.pi * np.arange(8) / 8:
            poses = np.array([[[0, 0, 0], [np.cos(bearing), np.sin(bearing), bearing + np.pi / 4]]])
            ranges = cast_scans(poses, np.ones((1, 2), dtype=bool), square, Arena.open(), config)[0, 0]
            index = (bearing + np.pi) / config.angle_increment
            if abs(index - round(index)) < 1e-9:
                assert ranges[round(index) % rays] == pytest.approx(1 - 0.2 * np.sqrt(2), abs=1e-12)
            seen = np.flatnonzero(np.isfinite(np.roll(ranges, rays // 2 - round(index))))
            assert np.array_equal(seen, np.arange(seen.min(), seen.max() + 1)) if len(seen) else rays <= 8


def test_nearer_obstacles_hide_farther_ones() -> None:
    poses = np.array([[[0.0, 0, 0], [1.0, 0, 0], [1.5, 0, 0]]])
    ranges = cast_scans(poses, np.ones((1, 3), dtype=bool), ROBOMASTER_EP, Arena.open(), CONFIG)
    ahead = 225
    assert ranges[0, 0, ahead] == pytest.approx(1 - 0.16, abs=1e-12)
    # The middle robot's 0.24 m at 0.84 m cover all of the last robot's 0.24 m at 1.34 m.
    without = cast_scans(poses[:, :2], np.ones((1, 2), dtype=bool), ROBOMASTER_EP, Arena.open(), CONFIG)
    np.testing.assert_array_equal(ranges[0, 0], without[0, 0])


def test_limits_of_range_and_robots_inside_each_other() -> None:
    active = np.ones((1, 2), dtype=bool)

    def ahead(distance: float) -> float:
        poses = np.array([[[0.0, 0, 0], [distance, 0, 0]]])
        return float(cast_scans(poses, active, ROBOMASTER_EP, Arena.open(), CONFIG)[0, 0, 225])

    assert ahead(2.159) == pytest.approx(1.999)
    assert ahead(2.161) == np.inf
    assert ahead(0.181) == pytest.approx(0.021)
    assert ahead(0.179) == -np.inf
    for distance in (0.0, 0.1):
        poses = np.array([[[0.0, 0, 0], [distance, 0, 0]]])
        ranges = cast_scans(poses, active, ROBOMASTER_EP, Arena.open(), CONFIG)
        assert np.all(ranges == -np.inf)
    # Something below range_min still hides what is behind it.
    poses = np.array([[[0.0, 0, 0], [0.17, 0, 0], [1.0, 0, 0]]])
    ranges = cast_scans(poses, np.ones((1, 3), dtype=bool), ROBOMASTER_EP, Arena.open(), CONFIG)
    assert ranges[0, 0, 225] == -np.inf


def test_a_room_is_seen_in_closed_form() -> None:
    config = ScanConfig(rays=360, range_max=10.0)
    poses = np.array([[[0.5, -0.25, 0.3]]])
    ranges = cast_scans(poses, np.ones((1, 1), dtype=bool), DISC, Arena.room(6, 4), config)[0, 0]
    angles = config.angles + 0.3
    with np.errstate(divide="ignore"):
        along_x = np.where(np.cos(angles) > 0, (3 - 0.5) / np.cos(angles), (-3 - 0.5) / np.cos(angles))
        along_y = np.where(np.sin(angles) > 0, (2 + 0.25) / np.sin(angles), (-2 + 0.25) / np.sin(angles))
    np.testing.assert_allclose(ranges, np.minimum(along_x, along_y), atol=1e-12)


def test_batched_equals_looped_and_rotation_does_not_matter() -> None:
    poses = sample_starts(6, 4, 3)
    active = np.ones((4, 6), dtype=bool)
    active[1, 2] = False
    ranges = cast_scans(poses, active, ROBOMASTER_EP, Arena.open(), CONFIG)
    for b in range(4):
        out = np.empty((6, 450))
        axes, nothing = np.empty((6, 2)), Arena.open()
        scene = (Scene(ROBOMASTER_EP.body, nothing.walls, nothing.pillars), scan_rays(CONFIG))
        cast_world(poses[b], active[b], *scene, axes, out)
        np.testing.assert_array_equal(out, ranges[b])
    turn, cos, sin = 1.1, np.cos(1.1), np.sin(1.1)
    turned = poses.copy()
    turned[..., :2] = poses[..., :2] @ np.array([[cos, sin], [-sin, cos]]) + [3.0, -2.0]
    turned[..., 2] += turn
    again = cast_scans(turned, active, ROBOMASTER_EP, Arena.open(), CONFIG)
    finite = np.isfinite(ranges)
    np.testing.assert_array_equal(finite, np.isfinite(again))
    np.testing.assert_allclose(again[finite], ranges[finite], atol=1e-9)


def test_a_wall_may_be_seen_from_both_sides_and_stood_on() -> None:
    wall = Arena("wall", np.array([[1.0, -1.0, 1.0, 1.0]]))
    poses = np.array([[[0.0, 0, 0]], [[2.0, 0, np.pi]], [[1.0, 0, 0]], [[1.0, 1.5, 0]]])
    ranges = cast_scans(poses, np.ones((4, 1), dtype=bool), DISC, wall, CONFIG)
    assert ranges[0, 0, 225] == ranges[1, 0, 225] == pytest.approx(1.0)
    assert np.all(ranges[2] == -np.inf)
    assert np.all(ranges[3] == np.inf)


@pytest.mark.parametrize("shapes", [((2, 3), (2,)), ((1, 2, 3), (1, 3)), ((1, 2, 2), (1, 2))])
def test_shapes_are_checked(shapes: tuple[tuple[int, ...], tuple[int, ...]]) -> None:
    with pytest.raises(ConfigurationError, match="are needed"):
        cast_scans(np.zeros(shapes[0]), np.ones(shapes[1], dtype=bool), DISC, Arena.open(), CONFIG)
    with pytest.raises(ConfigurationError, match="offsets"):
        cast_scans(np.zeros((1, 1, 3)), np.ones((1, 1), dtype=bool), DISC, Arena.open(), CONFIG, np.zeros((1, 1, 3)))


BANDS = (NoiseBand(0.5, absolute=0.0025), NoiseBand(1.0, absolute=0.005), NoiseBand(np.inf, relative=0.005))


def test_noise_has_the_promised_moments() -> None:
    lidar = LidarConfig(scan=ScanConfig(rays=40_000, range_max=8.0), noise=BANDS, dropout=0.1)
    rng = np.random.default_rng(0)
    for distance, sigma in [(0.3, 0.0025), (0.5, 0.0025), (0.8, 0.005), (1.5, 0.0075), (4.0, 0.02)]:
        measured = apply_noise(np.full(lidar.scan.rays, distance), lidar, rng)
        lost = np.isnan(measured)
        assert lost.mean() == pytest.approx(0.1, abs=5 * np.sqrt(0.09 / lost.size))
        errors = measured[~lost] - distance
        assert errors.std() == pytest.approx(sigma, rel=0.025)
        assert abs(errors.mean()) < 5 * sigma / np.sqrt(errors.size)
        assert np.mean(np.abs(errors) < 2 * sigma) == pytest.approx(0.9545, abs=0.01)
        assert noise_sigma(np.array([distance]), BANDS)[0] == pytest.approx(sigma)


def test_noise_leaves_what_is_no_range_and_respects_the_limits() -> None:
    lidar = LidarConfig(scan=ScanConfig(rays=3000, range_min=0.1, range_max=2.0), noise=constant_noise(0.01))
    rng = np.random.default_rng(0)
    for value in (np.inf, -np.inf):
        assert np.all(apply_noise(np.full(3000, value), lidar, rng) == value)
    far = apply_noise(np.full(3000, 2.0), lidar, rng)
    assert np.mean(far == np.inf) == pytest.approx(0.5, abs=0.05)
    near = apply_noise(np.full(3000, 0.1), lidar, rng)
    assert np.mean(near == -np.inf) == pytest.approx(0.5, abs=0.05)
    exact = np.full(3000, 1.0)
    assert apply_noise(exact, LidarConfig(scan=lidar.scan), rng) is exact


def test_angle_errors_have_the_promised_moments() -> None:
    errors = angle_offsets((3, 20_000), LidarConfig(angle_noise=0.01), np.random.default_rng(1))
    assert errors.std() == pytest.approx(0.01, rel=0.02)
    assert not angle_offsets((3, 5), LidarConfig(), np.random.default_rng(1)).any()
