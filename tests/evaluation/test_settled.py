from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.formations import PERIOD, hexagon, still
from triform.evaluation import Trajectory, measure, summarise
from triform.evaluation.metrics import settle
from triform.geometry import assess

LINE = np.stack([np.arange(7.0), np.zeros(7)], axis=-1)


def switching(flags, period=PERIOD, speed=0.0):
    """One team of seven that is a hexagon where ``flags`` say so and else a line, and moves along y."""
    time = period * np.arange(len(flags))
    positions = np.where(np.asarray(flags)[:, None, None], hexagon(), LINE)
    positions = positions + np.stack([np.zeros_like(time), speed * time], axis=-1)[:, None]
    poses = np.concatenate([positions, np.zeros((len(flags), 7, 1))], axis=-1)[None]
    return Trajectory(time, poses, np.ones(poses.shape[:3], dtype=bool), np.zeros((1, len(flags) - 1, 7, 3)))


def slow_settle(trajectory, every):
    """By the words, one record after the other."""
    time, positions = trajectory.time, trajectory.positions[0]
    looked = [record for record in range(len(time)) if (len(time) - 1 - record) % every == 0]
    strict = [bool(assess(positions[record], 1.0).strict) for record in looked]
    since = np.nan
    for record, is_strict in zip(reversed(looked), reversed(strict), strict=True):
        if not is_strict:
            break
        since = time[record]
    latest = [flag for record, flag in zip(looked, strict, strict=True) if time[record] > time[-1] - 5 + 1e-6]
    speeds = [
        np.linalg.norm(positions[record + 1, robot] - positions[record, robot]) / (time[record + 1] - time[record])
        for record in range(len(time) - 1)
        for robot in range(positions.shape[1])
        if time[record] >= max(since, time[-1] - 5) - 1e-6
    ]
    return since, np.mean(latest), np.median(speeds) if np.isfinite(since) and speeds else np.nan


@settings(deadline=None, max_examples=60)
@given(
    st.sampled_from([(0.1, 5), (0.125, 4), (0.5, 1), (0.02, 25)]),
    st.lists(st.tuples(st.booleans(), st.floats(0.05, 4.0)), min_size=1, max_size=6),
    st.integers(0, 3),
    st.floats(0.0, 0.3),
)
def test_settling_follows_its_definition(timing, pieces, extra, speed):
    period, every = timing
    flags = [flag for flag, length in pieces for _ in range(max(1, round(length / period)))]
    flags += [flags[-1]] * (max(0, round(5.5 / period) - len(flags)) + extra)
    trajectory = switching(flags, period, speed)
    found = settle(trajectory)
    expected = slow_settle(trajectory, every)
    np.testing.assert_allclose(
        [found[name][0] for name in ("strict_time", "strict_hold", "settled_speed")], expected, atol=1e-9
    )


def test_a_run_settles_when_it_is_strict_for_good():
    time = PERIOD * np.arange(201)
    table = settle(switching((time > 4) & ((time < 8) | (time > 12.25)), speed=0.02))
    assert table["strict_time"] == pytest.approx(12.5)
    assert table["strict_hold"] == 1
    assert table["settled_speed"] == pytest.approx(0.02)


def test_hold_is_a_share_of_the_last_five_seconds():
    time = PERIOD * np.arange(201)
    table = settle(switching((time < 18.2) | (time > 19.7)))
    # Of 15.5, 16, ... 20 s those at 18.5, 19 and 19.5 s are not strict.
    assert table["strict_hold"] == pytest.approx(0.7)
    assert table["strict_time"] == pytest.approx(20.0)
    assert np.isnan(table["settled_speed"]).all()


def test_who_does_not_end_strict_has_no_time_and_no_speed():
    time = PERIOD * np.arange(201)
    summary = summarise(measure(switching(time < 19.95)))
    assert np.isnan(summary["strict_time_median"])
    assert np.isnan(summary["settled_speed_median"])
    assert summary["strict_hold_mean"] == pytest.approx(0.9)


def test_speeds_before_the_last_five_seconds_do_not_count():
    trajectory = still([hexagon()], duration=10)
    early = trajectory.time < 4.9
    trajectory.poses[0, early, :, 0] += 0.3 * trajectory.time[early, None]
    assert settle(trajectory)["settled_speed"] == pytest.approx(0.0)


def test_settling_counts_in_units_of_the_distance_and_leaves_absent_robots_out():
    padded = np.concatenate([hexagon(0.6), [[0.3, 0.2]]])
    table = measure(still([padded], active=[[True] * 7 + [False]]), distance=0.6)
    assert table["strict_time"] == 0
    assert table["settled_speed"] == 0
