"""Scans of any LiDAR on the fixed grid: in whatever order its rays come, the same scene gives the same scan."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.robots.laser_scan import LaserScan
from triform.simulation import Mounting
from triform.types import ConfigurationError, ScanConfig

GRID = ScanConfig(rays=450)
TURN = 2 * math.pi

seeds = st.integers(0, 2**32 - 1)
ray_counts = st.integers(240, 1500)


def random_ranges(rays: int, seed: int) -> np.ndarray:
    """Ranges of all kinds, within the limits of the grid or nothing at all."""
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.1, 1.9, rays).astype(np.float32)
    for value in (np.inf, -np.inf, np.nan):
        ranges[rng.random(rays) < 0.1] = value
    return ranges


def scan_of(ranges: np.ndarray, angle_min: float, step: float, **changed: Any) -> LaserScan:
    """A scan as a driver sends it: angles are float32."""
    last = angle_min + (len(ranges) - 1) * step
    told: dict[str, Any] = {
        "angle_min": float(np.float32(angle_min)),
        "angle_max": float(np.float32(last)),
        "angle_increment": float(np.float32(step)),
        "range_min": 0.02,
        "range_max": 12.0,
    }
    return LaserScan(ranges, **(told | changed))


@settings(deadline=None, max_examples=100)
@given(
    rays=ray_counts,
    seed=seeds,
    clockwise=st.booleans(),
    first=st.integers(0, 5000),
    turns=st.integers(-1, 1),
    both_ends=st.booleans(),
)
def test_a_full_turn_in_any_order_is_the_same_scan(
    rays: int, seed: int, clockwise: bool, first: int, turns: int, both_ends: bool
) -> None:
    grid = ScanConfig(rays=rays)
    ranges = random_ranges(rays, seed)
    order = (first + (-1 if clockwise else 1) * np.arange(rays + both_ends)) % rays
    step = -grid.angle_increment if clockwise else grid.angle_increment
    sent = scan_of(ranges[order], grid.angles[order[0]] + turns * TURN, step)
    np.testing.assert_array_equal(sent.on_grid(grid), ranges)
    assert sent.coverage == pytest.approx(1)


@settings(deadline=None, max_examples=100)
@given(rays=ray_counts, seed=seeds, clockwise=st.booleans(), start=st.floats(-7, 7), share=st.floats(0.1, 1))
def test_every_ray_takes_the_nearest_measurement_and_none_where_there_is_none(
    rays: int, seed: int, clockwise: bool, start: float, share: float
) -> None:
    step = (-1 if clockwise else 1) * TURN / rays
    count = max(2, int(share * rays))
    ranges = np.random.default_rng(seed).uniform(0.1, 1.9, count).astype(np.float32)
    placed = scan_of(ranges, start, step).on_grid(GRID)
    # On the unit circle, where no angle wraps.
    measured = np.exp(1j * (start + step * np.arange(count)))
    apart = 2 * np.arcsin(np.minimum(1, np.abs(np.exp(1j * GRID.angles)[:, None] - measured) / 2))
    nearest, reach = apart.min(axis=1), max(abs(step), GRID.angle_increment) / 2
    unsure = np.abs(nearest - reach) < 0.02 * reach + 0.02 * abs(step)
    np.testing.assert_array_equal(np.isnan(placed)[~unsure], (nearest > reach)[~unsure])
    for ray in np.flatnonzero(~np.isnan(placed)):
        ties = apart[ray] <= nearest[ray] + 1e-4 * abs(step) + 1e-5
        assert placed[ray] in ranges[ties]


def test_the_mounting_turns_a_scan() -> None:
    ahead = np.full(GRID.rays, np.inf, np.float32)
    ahead[np.abs(GRID.angles) < 0.1] = 1.0
    scan = scan_of(ahead, GRID.angle_min, GRID.angle_increment)
    left = scan.mounted(Mounting(yaw=math.pi / 2)).on_grid(GRID)
    assert np.abs(GRID.angles[np.isfinite(left)] - math.pi / 2).max() < 0.12


@settings(deadline=None, max_examples=50)
@given(seed=seeds, yaw=st.integers(0, GRID.rays - 1), clockwise=st.booleans())
def test_a_lidar_that_hangs_upside_down_sees_what_an_upright_one_sees(seed: int, yaw: int, clockwise: bool) -> None:
    """Hanging, it sweeps the same surroundings the other way round: ray k of the base is its own ray at yaw - angle."""
    ranges = random_ranges(GRID.rays, seed)
    mounting = Mounting(yaw=yaw * GRID.angle_increment, upright=False)
    sign = -1 if clockwise else 1
    own = GRID.angle_min + sign * GRID.angle_increment * np.arange(GRID.rays)
    towards = np.rint((mounting.yaw - own - GRID.angle_min) / GRID.angle_increment).astype(int) % GRID.rays
    hanging = scan_of(ranges[towards], own[0], sign * GRID.angle_increment)
    upright = scan_of(ranges, GRID.angle_min, GRID.angle_increment)
    np.testing.assert_array_equal(hanging.mounted(mounting).on_grid(GRID), upright.on_grid(GRID))


def test_what_is_no_range_is_told_by_rep_117() -> None:
    sent = np.array([np.nan, np.inf, -np.inf, 0.0, -1.0, 0.05, 0.1, 1.5, 1.6, 5.0], np.float32)
    told = np.array([np.nan, np.inf, -np.inf, np.nan, np.nan, -np.inf, 0.1, 1.5, 1.6, np.inf], np.float32)
    grid = ScanConfig(rays=10, range_max=1.55)
    scan = scan_of(sent, grid.angle_min, grid.angle_increment, range_min=0.1, range_max=4.0)
    np.testing.assert_array_equal(scan.on_grid(grid), told)
    near = ScanConfig(rays=10, range_min=0.3, range_max=1.55)
    assert scan.on_grid(near)[6] == -np.inf


def test_half_a_turn_leaves_the_other_half_unknown() -> None:
    scan = scan_of(np.ones(225, np.float32), -math.pi / 2, GRID.angle_increment)
    placed = scan.on_grid(GRID)
    assert scan.coverage == pytest.approx(0.5)
    np.testing.assert_array_equal(placed[np.abs(GRID.angles) < 1.5], 1.0)
    assert np.isnan(placed[np.abs(GRID.angles) > 1.6]).all()


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"angle_increment": 0.0}, "angle_increment is 0"),
        ({"angle_increment": math.nan}, "angle_increment is nan"),
        ({"angle_min": math.inf}, "angle_min is inf"),
        ({"angle_max": math.nan}, "angle_max is nan"),
        ({"angle_max": 1.0}, "and not at angle_max"),
        ({"ranges": np.ones(400, np.float32)}, "and not at angle_max"),
        ({"ranges": np.ones(1, np.float32)}, "1 rays"),
        ({"ranges": np.ones(0, np.float32)}, "0 rays"),
        ({"ranges": np.ones(500, np.float32), "angle_max": -math.pi + 499 * TURN / 450}, "more than a full turn"),
        ({"range_min": 3.0, "range_max": 2.0}, "range_min"),
        ({"range_max": math.nan}, "range_min"),
    ],
)
def test_a_scan_that_contradicts_itself_is_refused(changed: dict[str, Any], told: str) -> None:
    whole = scan_of(np.ones(450, np.float32), GRID.angle_min, GRID.angle_increment)
    with pytest.raises(ConfigurationError, match=told):
        replace(whole, **changed)


def test_a_lidar_that_does_not_suit_the_grid_is_refused() -> None:
    turn = (GRID.angle_min, GRID.angle_increment)
    with pytest.raises(ConfigurationError, match=r"reaches 1.5 m; 2 m are needed"):
        scan_of(np.ones(450, np.float32), *turn, range_max=1.5).on_grid(GRID)
    with pytest.raises(ConfigurationError, match="apart"):
        scan_of(np.ones(90, np.float32), -math.pi, TURN / 90).on_grid(GRID)
    assert (scan_of(np.ones(225, np.float32), -math.pi, TURN / 225).on_grid(GRID) == 1).all()


@settings(deadline=None, max_examples=60)
@given(rays=ray_counts, seed=seeds, clockwise=st.booleans(), start=st.floats(-7, 7), share=st.floats(0.1, 1))
def test_an_intensity_goes_with_its_range(rays: int, seed: int, clockwise: bool, start: float, share: float) -> None:
    """Where a ray of the grid has a range, it has the intensity that came with it."""
    step = (-1 if clockwise else 1) * TURN / rays
    count = max(2, int(share * rays))
    rng = np.random.default_rng(seed)
    ranges = rng.permutation(np.linspace(0.1, 1.9, count)).astype(np.float32)
    intensities = rng.integers(0, 256, count).astype(np.float32)
    scan = scan_of(ranges, start, step, intensities=intensities)
    placed, bright = scan.on_grid(GRID), scan.intensities_on_grid(GRID)
    assert bright is not None
    of = dict(zip(ranges.tolist(), intensities.tolist(), strict=True))
    for metres, level in zip(placed.tolist(), bright.tolist(), strict=True):
        assert math.isnan(metres) or of[metres] == level


def test_intensities_are_as_many_as_ranges_or_not_known() -> None:
    ranges = np.ones(450, np.float32)
    for none in (None, np.zeros(0)):
        assert scan_of(ranges, 0.0, TURN / 450, intensities=none).intensities_on_grid(GRID) is None
    with pytest.raises(
        ConfigurationError, match="the scan has 449 intensities and 450 ranges; it needs as many, or none"
    ):
        scan_of(ranges, 0.0, TURN / 450, intensities=np.ones(449))
