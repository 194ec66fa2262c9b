from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from triform.perception import map_rules, map_workspace, occupancy_maps, occupied_into
from triform.types import ConfigurationError, MapConfig, Scan, ScanConfig


def algorithm_3(ranges: np.ndarray, scan: ScanConfig, config: MapConfig, moved: np.ndarray | None = None) -> np.ndarray:
    """Algorithm 3 in SciPy: project, Gaussian over 3 x 3 cells, non-zero to one, drop groups by size."""
    hit = (ranges > 0) & (ranges <= scan.range_max)
    points = ranges[hit, None] * np.stack([np.cos(scan.angles), np.sin(scan.angles)], axis=1)[hit]
    if moved is not None:
        axes = np.array([[np.cos(moved[2]), -np.sin(moved[2])], [np.sin(moved[2]), np.cos(moved[2])]])
        points = (points - moved[:2]) @ axes
    index = np.floor((points + config.half_extent) / config.cell).astype(int)
    index = index[((index >= 0) & (index < config.size)).all(axis=1)]
    grid = np.zeros((config.size, config.size))
    grid[index[:, 0], index[:, 1]] = 1.0
    binary = ndimage.gaussian_filter(grid, sigma=1.0, radius=1, mode="constant") > 0
    labels, groups = ndimage.label(binary)
    for group in range(1, groups + 1):
        cells = labels == group
        if not config.min_cells <= cells.sum() <= config.max_cells:
            binary[cells] = False
    return binary.astype(np.uint8)


def seen_from(ranges: np.ndarray, scan: ScanConfig, config: MapConfig, moved: np.ndarray) -> np.ndarray:
    """The map of a scan for a robot that has moved since."""
    workspace = map_workspace(config.size)
    grid, cells = workspace.grid.copy(), workspace.cells
    rules = map_rules(scan, config)
    count = occupied_into(ranges, moved, np.cos(scan.angles), np.sin(scan.angles), rules, workspace)
    np.testing.assert_array_equal(workspace.grid, grid)
    assert len(set(cells[:count].tolist())) == count
    out = np.zeros(config.size**2, dtype=np.uint8)
    out[cells[:count]] = 1
    return out.reshape(config.size, config.size)


configs = st.builds(
    MapConfig,
    size=st.integers(3, 60),
    cell=st.sampled_from([0.04, 0.05, 0.11]),
    min_cells=st.integers(0, 14),
    max_cells=st.integers(14, 200),
)
wild = st.one_of(
    st.floats(-1, 4),
    st.sampled_from([np.inf, -np.inf, np.nan, 0.0, -1.0, 2.0, 1.9999999999999998]),
)


@settings(deadline=None, max_examples=150)
@given(st.data())
def test_equals_scipy_bit_for_bit_on_any_ranges(data: st.DataObject) -> None:
    scan = ScanConfig(rays=data.draw(st.integers(1, 90)), angle_min=data.draw(st.sampled_from([-np.pi, 0.0, 0.3])))
    config = data.draw(configs)
    ranges = np.array(data.draw(st.lists(wild, min_size=scan.rays, max_size=scan.rays)))
    np.testing.assert_array_equal(occupancy_maps(Scan(ranges, scan), config), algorithm_3(ranges, scan, config))


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.9))
def test_equals_scipy_on_scenes_of_arcs_specks_and_walls(seed: int, share_lost: float) -> None:
    rng = np.random.default_rng(seed)
    scan, config = ScanConfig(), MapConfig()
    ranges = np.full(scan.rays, np.inf)
    for _ in range(rng.integers(0, 8)):
        first, width = rng.integers(scan.rays), rng.integers(1, 60)
        ranges[np.arange(first, first + width) % scan.rays] = rng.uniform(0.2, 2.0) + rng.normal(0, 0.02, width)
    wall = rng.uniform(0.5, 2.0) / np.maximum(np.cos(scan.angles - rng.uniform(-np.pi, np.pi)), 1e-9)
    ranges = np.where((wall <= 2.0) & (rng.random() < 0.5), np.minimum(wall, ranges), ranges)
    ranges[rng.random(scan.rays) < share_lost * rng.random()] = np.nan
    np.testing.assert_array_equal(occupancy_maps(Scan(ranges, scan), config), algorithm_3(ranges, scan, config))


@settings(deadline=None, max_examples=80)
@given(st.integers(0, 2**32 - 1), configs, st.floats(0.0, 3.0), st.floats(-10.0, 10.0))
def test_who_has_moved_sees_the_same_returns_from_there(
    seed: int, config: MapConfig, way: float, turned: float
) -> None:
    rng = np.random.default_rng(seed)
    scan = ScanConfig(rays=int(rng.integers(1, 200)))
    ranges = np.where(rng.random(scan.rays) < 0.8, rng.uniform(-0.1, 2.3, scan.rays), np.inf)
    ranges[rng.random(scan.rays) < 0.05] = np.nan
    direction = rng.uniform(-np.pi, np.pi)
    moved = np.array([way * np.cos(direction), way * np.sin(direction), turned])
    np.testing.assert_array_equal(seen_from(ranges, scan, config, moved), algorithm_3(ranges, scan, config, moved))
    there = occupancy_maps(Scan(np.stack([ranges] * 2), scan), config, np.stack([np.zeros(3), moved]))
    at_rest = occupancy_maps(Scan(ranges, scan), config)
    np.testing.assert_array_equal(there, [at_rest, algorithm_3(ranges, scan, config, moved)])
    np.testing.assert_array_equal(seen_from(ranges, scan, config, np.zeros(3)), at_rest)


def test_what_is_passed_lies_behind_and_a_left_turn_moves_it_to_the_right() -> None:
    scan, config = ScanConfig(rays=4, angle_min=0.0), MapConfig(min_cells=0)
    ahead = np.array([0.51, np.inf, np.inf, np.inf])
    passed = seen_from(ahead, scan, config, np.array([1.02, 0.0, 0.0]))
    np.testing.assert_array_equal(np.argwhere(passed).mean(axis=0), [37, 50])
    turned = seen_from(ahead, scan, config, np.array([0.0, 0.0, np.pi / 2 - 1e-6]))
    np.testing.assert_array_equal(np.argwhere(turned).mean(axis=0), [50, 37])
    # The range is that of the scan, wherever the robot is now.
    far = np.array([2.01, np.inf, np.inf, np.inf])
    assert not seen_from(far, scan, config, np.array([1.0, 0.0, 0.0])).any()


def test_batches_equal_single_scans_and_leave_the_scan_alone() -> None:
    rng = np.random.default_rng(1)
    ranges = rng.uniform(0.1, 3.0, (2, 3, 450))
    before = ranges.copy()
    maps = occupancy_maps(Scan(ranges, ScanConfig()), MapConfig())
    np.testing.assert_array_equal(ranges, before)
    assert maps.shape == (2, 3, 100, 100)
    for b in range(2):
        for n in range(3):
            np.testing.assert_array_equal(maps[b, n], occupancy_maps(Scan(ranges[b, n], ScanConfig()), MapConfig()))


def test_rows_grow_forward_and_columns_to_the_left() -> None:
    scan = ScanConfig(rays=4, angle_min=0.0)
    config = MapConfig(min_cells=0)
    ahead = occupancy_maps(Scan(np.array([1.01, np.inf, np.inf, np.inf]), scan), config)
    left = occupancy_maps(Scan(np.array([np.inf, 1.01, np.inf, np.inf]), scan), config)
    np.testing.assert_array_equal(np.argwhere(ahead).mean(axis=0), [75, 50])
    np.testing.assert_array_equal(np.argwhere(left).mean(axis=0), [50, 75])


def test_a_single_return_is_noise_and_a_wall_is_dropped() -> None:
    scan = ScanConfig()
    ranges = np.full(450, np.inf)
    ranges[10] = 1.0
    assert not occupancy_maps(Scan(ranges, scan), MapConfig()).any()
    wall = 1.0 / np.maximum(np.cos(scan.angles), 1e-9)
    assert not occupancy_maps(Scan(np.where(wall <= 2, wall, np.inf), scan), MapConfig()).any()


def test_bad_input_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="450 rays"):
        Scan(np.zeros(449), ScanConfig())
    with pytest.raises(ConfigurationError, match="min_cells"):
        MapConfig(min_cells=20, max_cells=10)
    with pytest.raises(ConfigurationError, match="cell"):
        MapConfig(cell=0.0)
