"""Limits of acceleration against a search through all allowed commands, and odometry against motion that is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from triform.robots.limits import limit_acceleration
from triform.robots.odometry import Track
from triform.simulation import Drive

numbers = st.floats(-1, 1).map(lambda value: round(value, 3))
twists = st.tuples(numbers, numbers, numbers).map(np.array)


@given(twists, twists, st.floats(0.1, 5))
def test_commands_change_as_fast_as_allowed_and_never_beyond_what_is_wanted(
    wanted: np.ndarray, previous: np.ndarray, acceleration: float
) -> None:
    drive = Drive(max_acceleration=acceleration, max_turn_acceleration=2 * acceleration)
    given_out = limit_acceleration(wanted, previous, drive, 0.1)
    shares = np.linspace(0, 1, 2001)
    for axes, reach in ((slice(0, 2), 0.1 * acceleration), (slice(2, 3), 0.2 * acceleration)):
        allowed = shares[:, None] * wanted[axes]
        away = np.linalg.norm(allowed - previous[axes], axis=1)
        within = np.flatnonzero(away <= reach)
        best = allowed[within[-1]] if len(within) else allowed[np.argmin(away)]
        # A line that only just touches the circle of reach makes the longest share a matter of rounding.
        if not len(within) or away.min() < reach - 1e-3:
            np.testing.assert_allclose(given_out[axes], best, atol=2e-3)
        assert np.linalg.norm(given_out[axes] - previous[axes]) <= max(reach, away.min()) + 1e-9


def test_braking_and_reversing_are_not_delayed() -> None:
    drive = Drive(max_acceleration=1.0, max_turn_acceleration=1.0)
    fast = np.array([0.5, 0.0, 0.5])
    assert not limit_acceleration(np.zeros(3), fast, drive, 0.1).any()
    assert not limit_acceleration(-fast, fast, drive, 0.1).any()
    np.testing.assert_allclose(limit_acceleration(-fast, np.zeros(3), drive, 0.1), [-0.1, 0.0, -0.1])
    np.testing.assert_array_equal(limit_acceleration(fast, -fast, Drive(), 0.1), fast)


def test_poses_between_two_are_on_the_way_and_the_motion_goes_on_for_a_moment() -> None:
    history = Track([np.inf] * 3, angle=True)
    assert history.at(0.0) is None
    for step in range(11):
        time = 0.1 * step
        history.add(time, np.array([time, -2 * time, (3.0 + time + np.pi) % (2 * np.pi) - np.pi]))
    for time in (0.0, 0.05, 0.123, 0.5, 1.0, 1.15):
        pose = history.at(time)
        assert pose is not None
        np.testing.assert_allclose(pose[:2], [time, -2 * time], atol=1e-12)
        assert np.exp(1j * pose[2]) == pytest.approx(np.exp(1j * (3.0 + time)))
    assert history.at(-0.01) is None
    assert history.at(1.25) is None


def test_poses_are_forgotten_and_a_clock_that_jumps_back_starts_anew() -> None:
    history = Track([np.inf] * 3, angle=True)
    for time in range(150):
        history.add(float(time), np.zeros(3))
    assert history.at(49.0) is None
    assert history.at(50.0) is not None
    history.add(0.0, np.zeros(3))
    assert history.at(149.0) is None
    history.add(0.1, np.zeros(3))
    history.add(0.1, np.ones(3))
    np.testing.assert_array_equal(history.at(0.1), np.ones(3))
