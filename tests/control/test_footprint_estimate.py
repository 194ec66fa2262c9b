"""Estimates of unknown footprints, against closed forms, a search over headings, and scenes cast by Shapely."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from shapely import Point, Polygon
from shapely.affinity import rotate, translate
from shapely.geometry import LineString, box

from triform.control.detection import detect_robots
from triform.control.footprint_estimate import GRAZING_SINE, find_corner, fit_disc, fit_one_side, fit_two_sides
from triform.types import FloatArray, Scan, ScanConfig

CONFIG = ScanConfig(range_max=3.0)


def cast(shapes: list[Polygon], angles: FloatArray) -> FloatArray:
    """Ranges from the origin [m], cast by Shapely."""
    ranges = np.full(len(angles), np.inf)
    for k, angle in enumerate(angles):
        ray = LineString([(0, 0), (3 * np.cos(angle), 3 * np.sin(angle))])
        hits = [hit.distance(Point(0, 0)) for hit in map(ray.intersection, shapes) if not hit.is_empty]
        ranges[k] = min(hits, default=np.inf)
    return ranges


def disc(x: float, y: float, diameter: float) -> Polygon:
    return Point(x, y).buffer(diameter / 2, quad_segs=64)


def rectangle(x: float, y: float, heading: float, length: float, width: float) -> Polygon:
    shape = box(-length / 2, -width / 2, length / 2, width / 2)
    return translate(rotate(shape, heading, origin=(0, 0), use_radians=True), x, y)


def seen(shape: Polygon, rays: int = 4000) -> tuple[FloatArray, FloatArray]:
    """Points of a shape ahead and its silhouette edges, as the kernels take them."""
    angles = np.linspace(-1, 1, rays)
    ranges = cast([shape], angles)
    hit = np.flatnonzero(np.isfinite(ranges))
    half = (angles[1] - angles[0]) / 2
    edges = np.array([[angles[hit[0]] - half, half], [angles[hit[-1]] + half, half]])
    return ranges[hit, None] * np.stack([np.cos(angles[hit]), np.sin(angles[hit])], -1), edges


@settings(deadline=None, max_examples=8)
@given(st.floats(0.5, 2.5), st.floats(-0.3, 0.3), st.floats(0.08, 0.55))
def test_a_disc_is_found_where_it_is(distance, bearing, diameter):
    truth = distance * np.array([np.cos(bearing), np.sin(bearing)])
    points, edges = seen(disc(*truth, diameter))
    pose = np.empty(3)
    cost, found = fit_disc(points, len(points), edges, pose)
    assert np.linalg.norm(pose[:2] - truth) < 0.005
    assert found == pytest.approx(diameter, abs=0.006)
    assert cost < 0.003


@settings(deadline=None, max_examples=8)
@given(st.floats(0.8, 2.5), st.floats(0.35, 1.2), st.floats(0.15, 0.5), st.floats(0.15, 0.5))
@example(0.8046875, 0.5, 0.5, 0.5)
def test_a_box_of_which_two_sides_show_is_found_where_it_is(distance, heading, length, width):
    points, edges = seen(rectangle(distance, 0.1, heading, length, width))
    pose = np.empty(3)
    cost, first, second = fit_two_sides(points, len(points), edges, pose)
    # A side that the silhouette ray at its end grazes does not say how long it is.
    sines = abs(np.cos(edges[0, 0] - heading)), abs(np.sin(edges[1, 0] - heading))
    if min(sines) < 0.9 * GRAZING_SINE:
        assert cost == np.inf
        return
    assume(min(sines) > 1.3 * GRAZING_SINE)
    assert np.linalg.norm(pose[:2] - [distance, 0.1]) < 0.01
    assert sorted([first, second]) == pytest.approx(sorted([length, width]), abs=0.02)
    assert cost < 0.002


def test_two_sides_of_a_notch_are_no_box():
    # The inside of a corner: both walls come nearer to the observer from the middle on.
    steps = np.linspace(0, 0.3, 20)[1:]
    low, high = np.column_stack([1.3 - steps, -steps])[::-1], np.column_stack([1.3 - steps, steps])
    points = np.concatenate([low, high])
    ends = np.arctan2(points[[0, -1], 1], points[[0, -1], 0])
    edges = np.array([[ends[0] - 0.005, 0.005], [ends[1] + 0.005, 0.005]])
    assert fit_two_sides(points, len(points), edges, np.empty(3))[0] == np.inf


@pytest.mark.parametrize("tilt", [0.0, 0.3, -0.5])
def test_a_side_ends_at_its_silhouette(tilt):
    t, n = np.array([-np.sin(tilt), np.cos(tilt)]), np.array([np.cos(tilt), np.sin(tilt)])
    middle, side = np.array([1.2, 0.1]), np.empty(4)
    points = middle + np.linspace(-0.15, 0.15, 30)[:, None] * t
    bearing = np.arctan2(*(middle + np.array([[-0.155], [0.155]]) * t).T[::-1])
    cost, length = fit_one_side(points, len(points), np.column_stack([bearing, [0.005, 0.005]]), side)
    assert cost < 1e-7
    assert length == pytest.approx(0.31, abs=1e-9)
    np.testing.assert_allclose(side, [*middle, *n], atol=1e-9)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(5, 12))
def test_the_corner_is_the_best_of_all_headings(seed, count):
    points = np.random.default_rng(seed).normal([1.0, 0.5], 0.1, (count, 2))
    corner, direction, cost = find_corner(points, count, 2, count - 1)

    def squares(k: int, heading: float) -> float:
        along = points @ [np.cos(heading), np.sin(heading)]
        across = points @ [-np.sin(heading), np.cos(heading)]
        return float(k * across[:k].var() + (count - k) * along[k:].var())

    best = min(squares(k, heading) for k in range(2, count - 1) for heading in np.linspace(0, np.pi, 400))
    assert squares(corner, direction) == pytest.approx(count * cost**2, rel=1e-6, abs=1e-12)
    assert count * cost**2 <= best + 1e-12
    assert count * cost**2 >= best * 0.99 - 1e-9


def scene(seed: int, boxes: bool, hidden: bool) -> tuple[list[Polygon], FloatArray]:
    """Six robots of as many sizes at 1 m to 2 m around the observer, and one more behind the first if ``hidden``."""
    rng = np.random.default_rng(seed)
    bearings = rng.uniform(0, 2 * np.pi) + np.arange(6) * np.pi / 3 + rng.uniform(-0.1, 0.1, 6)
    distances = rng.uniform(1.0, 2.0, 6)
    if hidden:
        distances[0] = 1.0
        bearings, distances = np.append(bearings, bearings[0] + 0.2), np.append(distances, 1.9)
    centres = distances[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], -1)
    shapes = []
    for x, y in centres:
        sizes = rng.uniform(0.25, 0.5, 2) if hidden else rng.uniform(0.12, 0.5, 2)
        shapes.append(rectangle(x, y, rng.uniform(0, np.pi), *sizes) if boxes else disc(x, y, sizes[0]))
    return shapes, centres


def errors(scan: Scan, centres: FloatArray, noise: float = 0.0) -> FloatArray:
    """Distance of every true centre from the nearest estimate [m]; as many robots are found as there are."""
    found, count = detect_robots(scan, None, noise)
    assert count == len(centres)
    return np.linalg.norm(centres[:, None] - found[None], axis=-1).min(axis=1)


@pytest.mark.parametrize(("boxes", "median", "worst"), [(False, 0.01, 0.03), (True, 0.03, 0.15)])
def test_robots_of_unknown_sizes_are_found(boxes, median, worst):
    gaps = []
    for seed in range(8):
        shapes, centres = scene(seed, boxes, hidden=False)
        gaps.append(errors(Scan(cast(shapes, CONFIG.angles), CONFIG), centres))
    assert np.median(gaps) < median
    assert np.max(gaps) < worst


def test_a_robot_that_is_partly_hidden_has_the_size_of_the_others():
    gaps = []
    for seed in range(6):
        _, centres = scene(seed, boxes=False, hidden=True)
        shapes = [disc(x, y, 0.4) for x, y in centres]
        gaps.append(errors(Scan(cast(shapes, CONFIG.angles), CONFIG), centres)[[0, -1]])
    assert np.max(gaps) < 0.03


def test_range_noise_is_allowed_for():
    rng, gaps = np.random.default_rng(1), []
    for seed in range(6):
        shapes, centres = scene(seed, boxes=False, hidden=False)
        ranges = cast(shapes, CONFIG.angles)
        gaps.append(errors(Scan(ranges + rng.normal(0, 0.03, ranges.shape), CONFIG), centres, noise=0.03))
    assert np.median(gaps) < 0.02


def test_a_wall_is_no_robot():
    wall = box(1.0, -2.0, 1.1, 2.0)
    short = rectangle(-1.2, 0.0, 0.2, 0.05, 0.8)
    scan = Scan(cast([wall, short, disc(0.3, 1.0, 0.3)], CONFIG.angles), CONFIG)
    assert errors(scan, np.array([[0.3, 1.0]])).max() < 0.02
