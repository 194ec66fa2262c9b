from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.control.scan_packer import SCANS_AT_ONCE, ScanPacker
from triform.perception import occupancy_maps
from triform.policy import Keep, PackedMaps, pack
from triform.types import ConfigurationError, MapConfig, Scan, ScanConfig

SCAN = ScanConfig(rays=120)


def random_ranges(seed: int, scans: int) -> np.ndarray:
    """Scans of robot-sized things, walls, noise and rays without a return."""
    rng = np.random.default_rng(seed)
    ranges = np.full((scans, SCAN.rays), np.inf)
    for row in ranges:
        for _ in range(rng.integers(0, 6)):
            first, width = rng.integers(0, SCAN.rays), rng.integers(1, 30)
            row[(first + np.arange(width)) % SCAN.rays] = rng.uniform(0.1, 2.2) + rng.normal(0, 0.02, width)
    ranges[rng.random(ranges.shape) < 0.05] = np.nan
    return ranges


def assert_same(found: PackedMaps, wanted: PackedMaps) -> None:
    np.testing.assert_array_equal(found.counts, wanted.counts)
    np.testing.assert_array_equal(found.positions, wanted.positions)
    np.testing.assert_array_equal(found.patches, wanted.patches)


@settings(deadline=None, max_examples=40)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 5),
    st.sampled_from([(100, 10), (100, 20), (40, 5)]),
    st.sampled_from(["occupied", "all"]),
    st.sampled_from([np.float32, np.float64]),
)
def test_packing_scans_is_algorithm_3_and_packing(
    seed: int, scans: int, shape: tuple[int, int], keep: Keep, kind: type
) -> None:
    size, patch = shape
    config = MapConfig(size=size, cell=4.0 / size, min_cells=3)
    ranges = random_ranges(seed, scans).astype(kind)
    packer = ScanPacker(SCAN, config, patch, keep)
    for _ in range(2):
        assert_same(packer.pack(ranges), pack(occupancy_maps(Scan(ranges, SCAN), config), patch, keep))


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_scans_of_robots_that_have_moved(seed: int, scans: int) -> None:
    # No ray lies on an axis, which is an edge between cells.
    scan, config, ranges = replace(SCAN, angle_min=0.01), MapConfig(), random_ranges(seed, scans)
    packer = ScanPacker(scan, config, 10)
    assert_same(packer.pack(ranges, np.zeros((scans, 3))), pack(occupancy_maps(Scan(ranges, scan), config), 10))
    # Quarter turns take cells to cells and rays to rays.
    quarters = np.random.default_rng(seed).integers(-3, 4, scans)
    odometry = np.zeros((scans, 3))
    odometry[:, 2] = quarters * np.pi / 2
    turned = np.stack([np.roll(row, -each * scan.rays // 4) for row, each in zip(ranges, quarters, strict=True)])
    assert_same(packer.pack(ranges, odometry), pack(occupancy_maps(Scan(turned, scan), config), 10))


def test_threads_do_not_share_their_room() -> None:
    packer = ScanPacker(SCAN, MapConfig(), 10)
    batches = [random_ranges(seed, 60) for seed in range(24)]

    def packed(ranges: np.ndarray) -> PackedMaps:
        found = packer.pack(ranges)
        return PackedMaps(found.patches.copy(), found.positions.copy(), found.counts.copy())

    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(packed, batches))
    for ranges, result in zip(batches, results, strict=True):
        assert_same(result, pack(occupancy_maps(Scan(ranges, SCAN), MapConfig()), 10))


@pytest.mark.parametrize("scans", [0, 1, SCANS_AT_ONCE])
def test_any_number_of_scans_up_to_the_room(scans: int) -> None:
    ranges = np.full((scans, SCAN.rays), np.inf)
    packed = ScanPacker(SCAN, MapConfig(), 10).pack(ranges)
    assert packed.counts.tolist() == [0] * scans
    assert len(packed.patches) == len(packed.positions) == 0


def test_scans_of_another_form_are_refused() -> None:
    packer = ScanPacker(SCAN, MapConfig(), 10)
    for shape in ((SCANS_AT_ONCE + 1, SCAN.rays), (1, SCAN.rays + 1), (SCAN.rays,)):
        with pytest.raises(ConfigurationError, match="scans of 120 rays"):
            packer.pack(np.zeros(shape))
    with pytest.raises(ConfigurationError, match="patches of 30"):
        ScanPacker(SCAN, MapConfig(), 30)
