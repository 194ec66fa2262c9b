"""Exploration noise: standard normal, held for a while, and a function of seed, robot and time alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from triform.simulation.noise import exploration_noise, noise_keys
from triform.types import NOISE_PERIOD


def keys(*seeds: int) -> np.ndarray:
    return noise_keys([np.random.SeedSequence(seed) for seed in seeds], len(seeds))


@settings(deadline=None, max_examples=60)
@given(st.lists(st.integers(0, 2**63), min_size=1, max_size=5), st.integers(1, 60), st.integers(0, 10_000), st.data())
def test_a_function_of_seed_robot_and_slot_alone(seeds: list[int], robots: int, slot: int, data: st.DataObject) -> None:
    whole = exploration_noise(keys(*seeds), robots, NOISE_PERIOD * slot)
    assert whole.shape == (len(seeds), robots, 2)
    assert np.isfinite(whole).all()
    world, robot = data.draw(st.integers(0, len(seeds) - 1)), data.draw(st.integers(0, robots - 1))
    within = data.draw(st.floats(0.0, 0.999 * NOISE_PERIOD))
    alone = exploration_noise(keys(seeds[world]), robot + 1, NOISE_PERIOD * slot + within)
    np.testing.assert_array_equal(alone[0, robot], whole[world, robot])


def test_held_for_half_a_second_however_times_are_added_up() -> None:
    assert NOISE_PERIOD == 0.5
    for period in (0.1, 0.125, 1 / 6, 0.01):
        time, seen = 0.0, []
        for _ in range(round(3.0 / period)):
            seen.append(exploration_noise(keys(1), 1, time)[0, 0])
            time += period
        slots = np.unique(seen, axis=0, return_inverse=True)[1].reshape(-1)
        changes = 1 + np.flatnonzero(np.diff(slots))
        assert len(set(slots.tolist())) == 6
        np.testing.assert_array_equal(changes, np.ceil(NOISE_PERIOD * np.arange(1, 6) / period - 1e-6))


def test_standard_normal_and_independent() -> None:
    """Many numbers of one seed; the shares of chance failures are far below one in a thousand, and none is drawn."""
    many = np.stack([exploration_noise(keys(3, 4, 5), 500, NOISE_PERIOD * slot) for slot in range(40)])
    values = many.reshape(-1)
    assert stats.kstest(values, "norm").pvalue > 0.01
    n = len(values)
    assert abs(values.mean()) < 4 / np.sqrt(n)
    assert abs(values.var() - 1) < 4 * np.sqrt(2 / n)
    assert abs(stats.skew(values)) < 4 * np.sqrt(6 / n)
    assert abs(stats.kurtosis(values)) < 4 * np.sqrt(24 / n)
    # Axes, neighbouring robots, slots and worlds know nothing of each other.
    pairs = [
        (many[..., 0], many[..., 1]),
        (many[:, :, 1:], many[:, :, :-1]),
        (many[1:], many[:-1]),
        (many[:, 1:], many[:, :-1]),
        (many[..., 0] ** 2, many[..., 1] ** 2),
    ]
    for one, other in pairs:
        assert abs(np.corrcoef(one.reshape(-1), other.reshape(-1))[0, 1]) < 4 / np.sqrt(one.size)
    angles = np.arctan2(many[..., 1], many[..., 0]).reshape(-1)
    assert stats.kstest(angles, stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > 0.01


def test_no_number_comes_twice() -> None:
    many = np.stack([exploration_noise(keys(*range(10)), 40, NOISE_PERIOD * slot) for slot in range(50)])
    assert len(np.unique(many[..., 0])) == many[..., 0].size


@pytest.mark.parametrize("worlds", [1, 3])
def test_worlds_without_seeds_are_numbered(worlds: int) -> None:
    np.testing.assert_array_equal(noise_keys([], worlds), keys(*range(worlds)))
    assert noise_keys([], worlds).dtype == np.uint64
