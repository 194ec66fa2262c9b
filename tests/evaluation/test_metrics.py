from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.formations import PERIOD, hexagon, still
from triform.evaluation import converge_time, measure, summarise, trailing_mean
from triform.evaluation.metrics import closest, concatenate, select
from triform.types import ConfigurationError


def times(duration, period=PERIOD):
    return period * np.arange(round(duration / period) + 1)


def slow_trailing_mean(series, time, window=5.0):
    """By the words: the mean over (t - window, t], once a whole window has passed."""
    out = np.full(len(series), np.nan)
    for index, now in enumerate(time):
        if now - time[0] >= window - 1e-9:
            inside = (time > now - window + 1e-9) & (time <= now + 1e-9)
            out[index] = series[inside].mean()
    return out


@settings(deadline=None, max_examples=50)
@given(
    st.sampled_from([0.1, 0.125, 0.25]),
    st.floats(5.0, 12.0),
    arrays(np.float64, 200, elements=st.floats(0, 0.3)),
)
def test_trailing_mean_and_converge_time_follow_their_definition(period, duration, values):
    time = times(duration, period)
    series = values[: len(time)]
    expected = slow_trailing_mean(series, time)
    if not np.isfinite(expected).any():
        with pytest.raises(ConfigurationError, match="at least that long"):
            trailing_mean(series, time)
        return
    np.testing.assert_allclose(trailing_mean(series, time), expected, atol=1e-12)
    below = trailing_mean(series, time) < 0.1
    latest = next((t for t, rest in zip(time, map(all, suffixes(below)), strict=True) if rest), np.nan)
    np.testing.assert_equal(converge_time(series, time), latest)


def suffixes(values):
    return [values[start:] for start in range(len(values))]


def test_converge_time_waits_until_the_mean_has_forgotten_the_bad_beginning():
    time = times(40)
    error = np.where(time < 3 - 1e-9, 1.0, 0.0)
    # At 7.4 s the window (2.4, 7.4] holds the five bad records 2.5 ... 2.9 of fifty: exactly 10 %, not below.
    assert converge_time(error, time) == pytest.approx(7.5)


def test_converge_time_is_never_below_five_seconds():
    time = times(40)
    assert converge_time(np.zeros_like(time), time) == pytest.approx(5.0)


def test_converge_time_counts_from_the_last_relapse_and_needs_a_good_end():
    time = times(40)
    relapse = np.where((time > 20 - 1e-9) & (time < 21 - 1e-9), 1.0, 0.0)
    # Ten bad records; fewer than five are left once t - 5 >= 20.5.
    assert converge_time(relapse, time) == pytest.approx(25.5)
    assert np.isnan(converge_time(np.where(time > 39, 1.0, 0.0), time))


def test_converge_time_treats_each_run_alone_and_undefined_errors_as_bad():
    time = times(10)
    series = np.stack([np.zeros_like(time), np.full_like(time, np.nan), np.full_like(time, 0.11)])
    np.testing.assert_array_equal(np.isfinite(converge_time(series, time)), [True, False, False])


def test_hexagon_is_a_strict_and_compact_success():
    table = measure(still([hexagon()]))
    assert table["robots"] == 7
    assert table["edges"] == 12
    assert table["compactness"] == pytest.approx(12 / math.floor(21 - math.sqrt(81)))
    assert table["formation_error"] == pytest.approx(0, abs=1e-12)
    assert table["success"].all()
    assert table["success_sensed"].all()
    assert table["strict"].all()
    assert table["converge_time"] == pytest.approx(5.0)
    assert table["min_distance"] == pytest.approx(1.0)


def test_line_is_a_success_and_no_triangulation():
    table = measure(still([[[x, 0.0] for x in range(5)]]))
    assert table["success"].all()
    assert not table["strict"].any()
    assert table["compactness"] == pytest.approx(4 / math.floor(15 - math.sqrt(57)))


def test_square_has_its_diagonals_as_edges_which_are_too_long():
    table = measure(still([[[0, 0], [1, 0], [1, 1], [0, 1]]]))
    assert table["formation_error"] == pytest.approx(2 * (math.sqrt(2) - 1) / 6)
    assert not table["success"].any()
    assert not table["strict"].any()


def test_error_is_relative_to_the_prescribed_distance():
    assert measure(still([hexagon(0.77)]), distance=0.7)["formation_error"] == pytest.approx(0.1)


def test_formation_error_is_the_mean_over_the_last_five_seconds():
    trajectory = still([hexagon()], duration=10)
    stretched = trajectory.time > 8 - 1e-9
    trajectory.poses[:, stretched, :, :2] *= 1.2
    # 21 of the last 50 records are 20 % too wide.
    assert measure(trajectory)["formation_error"] == pytest.approx(0.2 * 21 / 50)


def test_teams_out_of_each_others_sight_count_as_success_only_within_it():
    triangle = hexagon()[:3]
    table = measure(still([np.concatenate([triangle, triangle + [5.0, 0.0]])]))
    assert not table["success"].any()
    assert table["success_sensed"].all()
    assert not table["connected_start"].any()
    assert not table["connected_end"].any()


def test_a_bay_wider_than_sight_is_told_from_a_defect():
    # Two arms of the lattice on a base of two rows; they are farther apart than robots see.
    arm = [(column + row % 2 / 2, row) for row in range(1, 5) for column in (0, 1)]
    base = [(x, 0.0) for x in range(7)] + [(x + 0.5, -1.0) for x in range(6)]
    places = base + arm + [(6 - x, row) for x, row in arm]
    bay = np.array(places) * [1.0, math.sqrt(0.75)]
    table = measure(still([bay]))
    assert not table["strict"].any()
    assert table["strict_sensed"].all()
    broken = bay.copy()
    broken[3] += [0.0, -0.2]
    assert not measure(still([broken]))["strict_sensed"].any()


def test_absent_robots_change_nothing():
    alone = measure(still([hexagon()]))
    padded = np.concatenate([hexagon(), [[0.3, 0.2], [9.0, 9.0]]])
    joined = measure(still([padded], active=[[True] * 7 + [False] * 2]))
    for name, column in alone.items():
        np.testing.assert_array_equal(joined[name], column, err_msg=name)


def test_one_robot_has_no_error_and_no_success():
    summary = summarise(measure(still([[[0.0, 0.0]]])))
    assert summary["success"] == 0
    assert np.isnan(summary["formation_error_median"])
    assert np.isnan(summary["compactness_mean"])
    assert summary["min_distance"] == np.inf


def test_two_robots_succeed_but_are_no_triangulation():
    summary = summarise(measure(still([[[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0], [1.5, 0.0]]])))
    assert summary["success"] == 0.5
    assert summary["strict"] == 0
    assert summary["compactness_mean"] == 1
    assert summary["formation_error_median"] == pytest.approx(0.25)
    assert summary["converge_time_median"] == pytest.approx(5.0)


def test_coincident_robots_are_measured():
    table = measure(still([[[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]]]))
    assert table["min_distance"] == 0
    assert np.isfinite(table["formation_error"]).all()


def test_closest_looks_at_every_record_and_only_at_robots_that_exist():
    trajectory = still([[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]] * 2)
    trajectory.poses[0, 30, 1, 0] = 0.25
    trajectory.active[1, :, 1] = False
    np.testing.assert_allclose(closest(trajectory), [0.25, 2.0])


def test_what_the_team_recorded_between_the_records_counts():
    recorded = {"min_distance": np.array([0.2]), "collision": np.array([True]), "hit_arena": np.array([True])}
    summary = summarise(measure(still([hexagon()]), **recorded))
    assert summary["min_distance"] == 0.2
    assert summary["collision"] == 1
    assert summary["hit_arena"] == 1


def test_a_run_shorter_than_the_window_is_refused():
    with pytest.raises(ConfigurationError, match="lasts 4 s"):
        measure(still([hexagon()], duration=4))


def test_summary_of_no_runs_is_undefined_rather_than_an_error():
    table = measure(still([hexagon()]))
    summary = summarise(select(table, np.array([False])))
    assert summary["runs"] == 0
    assert np.isnan(summary["success"])


def test_concatenate_keeps_order():
    tables = [measure(still([hexagon()])), measure(still([[[0.0, 0.0], [1.0, 0.0]]]))]
    np.testing.assert_array_equal(concatenate(tables)["robots"], [7, 2])
