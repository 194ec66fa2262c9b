"""Detection of robots in a scan, against Shapely, closed forms and true poses."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Point, Polygon
from shapely.affinity import rotate, translate
from shapely.geometry import LineString, box

from triform.control.detection import ROBOMASTER_EP_SIZE, detect_robots, most_robots
from triform.control.footprint_fit import improve_pose
from triform.control.footprint_geometry import mean_depth, mean_half_width, ray_interval, surface_residual
from triform.geometry import gabriel_graph
from triform.geometry.footprint import ROBOMASTER_EP, Footprint
from triform.simulation.arena import Arena
from triform.simulation.lidar import apply_noise, cast_scans
from triform.simulation.profiles import LidarConfig, constant_noise
from triform.simulation.spawning import sample_starts
from triform.types import ConfigurationError, FloatArray, Scan, ScanConfig

A, B = 0.160, 0.120
CONFIG = ScanConfig()


def shape_of(pose: FloatArray, round_: bool = False) -> Polygon:
    shape = Point(0, 0).buffer(A, quad_segs=2000) if round_ else box(-A, -B, A, B)
    return translate(rotate(shape, pose[2], origin=(0, 0), use_radians=True), pose[0], pose[1])


def shapely_scan(poses: FloatArray, config: ScanConfig = CONFIG) -> Scan:
    """Scan from the origin, cast by Shapely."""
    shapes = [shape_of(np.asarray(pose)) for pose in poses]
    ranges = np.full(config.rays, np.inf)
    for k, angle in enumerate(config.angles):
        ray = LineString([(0, 0), (config.range_max * np.cos(angle), config.range_max * np.sin(angle))])
        for shape in shapes:
            hit = ray.intersection(shape)
            if not hit.is_empty:
                ranges[k] = min(ranges[k], hit.distance(Point(0, 0)))
    return Scan(ranges, config)


def observed(others: list[tuple[float, float, float]], arena: Arena | None = None, config: ScanConfig = CONFIG) -> Scan:
    """Scan from the origin, heading 0, cast by the simulator."""
    poses = np.array([[(0.0, 0.0, 0.0), *others]])
    ranges = cast_scans(poses, np.ones(poses.shape[:2], bool), ROBOMASTER_EP, arena or Arena.open(), config)
    return Scan(ranges[0, 0], config)


def errors(centres: FloatArray, truth: FloatArray) -> FloatArray:
    """Distance of each true centre from the nearest estimate."""
    return np.linalg.norm(np.asarray(truth)[:, None, :2] - centres[None], axis=-1).min(axis=1)


poses = st.tuples(st.floats(0.5, 2.0), st.floats(-np.pi, np.pi), st.floats(-np.pi, np.pi)).map(
    lambda p: np.array([p[0] * np.cos(p[1]), p[0] * np.sin(p[1]), p[2]])
)


@settings(deadline=None, max_examples=100)
@given(poses, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_surface_residual_is_the_distance_from_the_visible_sides(pose, shift_x, shift_y):
    corners = np.array(shape_of(pose).exterior.coords)
    sides = []
    for start, end in itertools.pairwise(corners):
        middle = (start + end) / 2
        if (middle - pose[:2]) @ middle < -1e-9:  # the outward normal points towards the observer
            sides.append(LineString([start, end]))
    point = pose[:2] + np.array([shift_x, shift_y])
    expected = min(side.distance(Point(point)) for side in sides)
    height, _, _, beyond, _, _, _, _ = surface_residual(*point, pose, np.cos(pose[2]), np.sin(pose[2]), A, B, False)
    assert np.hypot(height, beyond) == pytest.approx(expected, abs=1e-9)


@settings(deadline=None, max_examples=100)
@given(poses, st.floats(-0.3, 0.3), st.booleans())
def test_ray_interval_agrees_with_shapely(pose, offset, round_):
    angle = np.arctan2(pose[1], pose[0]) + offset
    direction = np.array([np.cos(angle), np.sin(angle)])
    crossing = LineString([(0, 0), 5 * direction]).intersection(shape_of(pose, round_))
    entry, leave = ray_interval(*direction, pose, np.cos(pose[2]), np.sin(pose[2]), A, B, round_)
    if crossing.length < 1e-2:  # misses, or a corner's tip
        assert entry == np.inf or leave - entry < 1.1e-2
    else:
        along = np.array(crossing.coords) @ direction
        assert (entry, leave) == pytest.approx((along.min(), along.max()), abs=1e-5)


@pytest.mark.parametrize("round_", [False, True])
def test_mean_depth_and_width_are_averages_over_headings(round_):
    angles = np.linspace(0, 2 * np.pi, 20_001)[:-1]
    widths = 2 * (A * np.abs(np.cos(angles)) + B * np.abs(np.sin(angles))) if not round_ else np.full(4, 2 * A)
    area = np.pi * A * A if round_ else 4 * A * B
    assert mean_half_width(A, B, round_) == pytest.approx(widths.mean() / 2, rel=1e-6)
    # All lines that cross the shape, uniformly: their chords fill the area once per direction.
    assert mean_depth(A, B, round_) == pytest.approx(area / widths.mean() / 2, rel=1e-6)


def test_gauss_newton_finds_the_pose_of_two_clean_sides():
    truth = np.array([1.0, 0.2, 0.7])
    scan = shapely_scan(truth[None], ScanConfig(rays=2000))
    hit = np.isfinite(scan.ranges)
    angles = scan.config.angles[hit]
    points = scan.ranges[hit, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    pose = truth + [0.03, -0.03, 0.1]
    improve_pose(points, len(points), np.full((2, 2), np.nan), pose, (A, B, False), 0.0, 30)
    np.testing.assert_allclose(pose, truth, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_centres_in_scenes_cast_by_shapely(seed):
    rng = np.random.default_rng(seed)
    bearings = rng.uniform(0, 2 * np.pi) + np.arange(5) * 2 * np.pi / 5
    distances = rng.uniform(0.5, 1.8, 5)
    truth = np.stack([distances * np.cos(bearings), distances * np.sin(bearings), rng.uniform(-np.pi, np.pi, 5)], -1)
    centres, count = detect_robots(shapely_scan(truth))
    assert count == 5
    assert errors(centres, truth).max() < 0.012


def scenes(robots: int, runs: int, sigma: float, footprint: Footprint = ROBOMASTER_EP, arena: Arena | None = None):
    """Random scenes: measured scans, true centres in each observer's frame, Gabriel neighbours within 1.9 m."""
    placed = sample_starts(robots, runs, seed=11)
    active = np.ones(placed.shape[:2], bool)
    ranges = cast_scans(placed, active, footprint, arena or Arena.open(), CONFIG)
    lidar = LidarConfig(noise=constant_noise(sigma) if sigma else ())
    ranges = apply_noise(ranges, lidar, np.random.default_rng(5))
    offset = placed[:, None, :, :2] - placed[:, :, None, :2]
    cosine, sine = np.cos(placed[:, :, None, 2]), np.sin(placed[:, :, None, 2])
    body = np.stack(
        [cosine * offset[..., 0] + sine * offset[..., 1], cosine * offset[..., 1] - sine * offset[..., 0]], -1
    )
    return Scan(ranges, CONFIG), body, gabriel_graph(placed[..., :2], max_range=1.9)


def judge(scan: Scan, body: FloatArray, neighbours, footprint=ROBOMASTER_EP_SIZE, noise=0.0):
    """Errors of Gabriel neighbours [m], radial errors [m], share of them missed, share of detections that are false."""
    centres, counts = detect_robots(scan, footprint, noise)
    found, radial, false = [], [], 0
    for b, i in np.ndindex(counts.shape):
        others = np.delete(np.arange(body.shape[2]), i)
        seen = centres[b, i, : counts[b, i]]
        gaps = np.linalg.norm(body[b, i, others][:, None] - seen[None], axis=-1)
        false += int((gaps.min(axis=0) > 0.2).sum()) if seen.size else 0
        for row, j in enumerate(others):
            if neighbours[b, i, j]:
                nearest = gaps[row].argmin() if seen.size else -1
                found.append(gaps[row, nearest] if seen.size else np.inf)
                if found[-1] < 0.2:
                    radial.append(np.linalg.norm(seen[nearest]) - np.linalg.norm(body[b, i, j]))
    found = np.array(found)
    return found[found < 0.2], np.array(radial), np.mean(found >= 0.2), false / counts.sum()


@pytest.mark.parametrize(("sigma", "median", "p95"), [(0.0, 0.0005, 0.006), (0.01, 0.004, 0.012)])
def test_accuracy_on_random_scenes(sigma, median, p95):
    found, radial, missed, false = judge(*scenes(9, 30, sigma))
    assert len(found) > 500
    assert np.median(found) < median
    assert np.quantile(found, 0.95) < p95
    assert abs(radial.mean()) < 0.001  # no bias towards the near side
    assert missed < 0.005
    assert false < 0.002


def test_noise_that_is_told_leaves_robots_whole():
    noisy = scenes(9, 10, 0.05)
    _, _, missed, _ = judge(*noisy)
    assert missed > 0.2
    found, _, missed, false = judge(*noisy, noise=0.05)
    assert np.median(found) < 0.025
    assert missed < 0.1
    assert false < 0.02


@pytest.mark.parametrize(("footprint", "median"), [(ROBOMASTER_EP, 0.02), (Footprint.circle(0.1), 0.01)])
def test_unknown_footprints_on_random_scenes(footprint, median):
    found, radial, missed, false = judge(*scenes(9, 20, 0.0, footprint), footprint=None)
    assert np.median(found) < median
    assert abs(radial.mean()) < 0.01
    assert missed < 0.02
    assert false < 0.01


def test_circles_are_found_exactly():
    found, _, missed, false = judge(*scenes(9, 20, 0.0, Footprint.circle(0.3)), footprint=0.3)
    assert np.quantile(found, 0.95) < 1e-3
    assert missed == false == 0


@pytest.mark.parametrize("sigma", [0.0, 0.01])
def test_walls_are_not_robots(sigma):
    _, _, missed, false = judge(*scenes(7, 40, sigma, arena=Arena.room(5.6, 5.6)))
    assert missed < 0.01
    assert false < 0.005


def test_a_robot_across_the_wrap_around_is_one_robot():
    truth = [(-1.0, 0.01, 0.3)]
    for angle_min in (-np.pi, 0.0, 0.1):
        centres, count = detect_robots(observed(truth, config=ScanConfig(angle_min=angle_min)))
        assert count == 1
        assert errors(centres, truth)[0] < 0.006


def test_dropped_and_too_close_rays_do_not_matter():
    truth = [(1.0, 0.1, 0.4), (-0.3, -0.8, 0.0)]
    scan = observed(truth)
    ranges = scan.ranges.copy()
    ranges[::4] = np.nan
    ranges[1::40] = -np.inf
    centres, count = detect_robots(Scan(ranges, CONFIG))
    assert count == 2
    assert errors(centres, truth).max() < 0.012


def test_a_robot_cut_in_two_is_one_robot_and_the_thin_pole_before_it_none():
    truth = [(1.4, 0.0, np.pi / 2)]
    scan = observed(truth, Arena(pillars=np.array([[0.7, 0.0, 0.02]])))
    assert np.isfinite(scan.ranges[:225]).any()
    centres, count = detect_robots(scan)
    assert count == 1
    assert errors(centres, truth)[0] < 0.006


def test_touching_robots_are_split():
    truth = [(1.0, -0.14, 0.1), (1.03, 0.14, -0.1)]
    centres, count = detect_robots(observed(truth))
    assert count == 2
    assert errors(centres, truth).max() < 0.02


def test_specks_are_ignored():
    ranges = np.full(450, np.inf)
    ranges[[10, 100, 101, 300]] = 1.0, 0.5, 0.5, 1.9
    assert detect_robots(Scan(ranges, CONFIG))[1] == 0


def test_few_points_still_give_a_centre():
    for heading in np.linspace(0, np.pi, 7):
        truth = [(1.0, 0.02, heading)]
        scan = observed(truth, config=ScanConfig(rays=80))
        assert 3 <= np.isfinite(scan.ranges).sum() <= 6
        centres, count = detect_robots(scan)
        assert count == 1
        assert errors(centres, truth)[0] < 0.08


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 60).flatmap(lambda rays: st.lists(st.floats(), min_size=rays, max_size=rays)))
def test_any_ranges_give_a_defined_result(ranges):
    config = ScanConfig(rays=len(ranges))
    for footprint in (ROBOMASTER_EP_SIZE, None):
        centres, count = detect_robots(Scan(np.array(ranges), config), footprint)
        assert 0 <= count <= most_robots(config.rays)
        assert centres.shape == (count, 2)
        assert np.isfinite(centres).all()


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 1.0))
def test_random_clutter_gives_a_defined_result(seed, spread):
    rng = np.random.default_rng(seed)
    ranges = np.clip(1.0 + np.cumsum(rng.normal(0, 0.05, 450)) * spread, 0.05, 3.0)
    ranges[rng.random(450) < 0.1] = rng.choice([np.nan, np.inf, -np.inf, -1.0, 0.0])
    for footprint in (ROBOMASTER_EP_SIZE, None):
        centres, count = detect_robots(Scan(ranges, CONFIG), footprint, 0.5 * spread * (footprint is None))
        assert np.isfinite(centres).all()
        assert len(centres) == count


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, 0.0, -1.0, 5.0])
def test_scans_without_any_return(value):
    centres, counts = detect_robots(Scan(np.full((2, 3, 450), value), CONFIG))
    assert centres.shape == (2, 3, 0, 2)
    assert not counts.any()


def test_a_batch_equals_its_scans_and_is_padded():
    scan, _, _ = scenes(7, 3, 0.01)
    centres, counts = detect_robots(scan)
    for index in np.ndindex(counts.shape):
        single, count = detect_robots(Scan(scan.ranges[index], CONFIG))
        assert count == counts[index]
        np.testing.assert_array_equal(single, centres[index][:count])
        assert np.isnan(centres[index][count:]).all()


@pytest.mark.parametrize("noise", [-0.01, np.nan, np.inf])
def test_impossible_noise_is_refused(noise):
    with pytest.raises(ConfigurationError, match="noise is"):
        detect_robots(Scan(np.full(450, np.inf), CONFIG), noise=noise)


@pytest.mark.parametrize("footprint", [0.0, -1.0, np.nan, np.inf, (0.3, 0.0), (0.3,), (0.3, 0.2, 0.1)])
def test_impossible_footprints_are_refused(footprint):
    with pytest.raises(ConfigurationError, match="footprint is"):
        detect_robots(Scan(np.full(450, np.inf), CONFIG), footprint)
