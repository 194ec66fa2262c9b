from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from triform.engines import LocalEngine
from triform.evaluation import Trajectory, dynamic, measure, scenario
from triform.experiments.dynamic import (
    ChangedRuns,
    DynamicConfig,
    measure_changes,
    run_changes,
    run_dynamic,
    summarise_changes,
)
from triform.types import ConfigurationError

QUICK = {"controller": "expert-sensed", "robots": 3, "runs": 4, "seed": 1, "change_time": 6.0, "duration": 14.0}


@pytest.fixture(scope="module")
def addition():
    config = DynamicConfig(**QUICK)
    return run_changes(config, config.make_controller(), ChangedRuns("addition", 0, 4))


@pytest.fixture(scope="module")
def removal():
    config = DynamicConfig(**QUICK)
    return run_changes(config, config.make_controller(), ChangedRuns("removal", 0, 4))


def test_an_added_robot_appears_at_the_moment_of_change_near_the_others(addition):
    trajectory, table = addition
    counts = trajectory.active[0].sum(axis=-1)
    assert (counts[trajectory.time < 6 - 1e-6] == 3).all()
    assert (counts[trajectory.time > 6 - 1e-6] == 4).all()
    at = np.searchsorted(trajectory.time, 6 - 1e-6)
    for run, robot in enumerate(table["changed_robot"]):
        apart = np.linalg.norm(trajectory.positions[run, at] - trajectory.positions[run, at, robot], axis=-1)
        apart = np.delete(apart, robot)
        assert apart.min() >= 0.5
        assert apart.min() <= 2.0


def test_a_removed_robot_is_gone_from_the_moment_of_change(removal):
    trajectory, table = removal
    for run, robot in enumerate(table["changed_robot"]):
        present = trajectory.active[run, :, robot]
        np.testing.assert_array_equal(present, trajectory.time < 6 - 1e-6)
        assert np.isnan(trajectory.poses[run, ~present, robot]).all()
    assert len(set(table["changed_robot"])) > 1


def test_the_rest_of_the_team_moves_on_without_a_jump(removal):
    trajectory, _ = removal
    steps = np.linalg.norm(np.diff(trajectory.positions, axis=1), axis=-1)
    assert np.nanmax(steps) <= 0.05 + 1e-9


def test_recovery_is_measured_on_the_changed_team_after_the_change(addition):
    trajectory, table = addition
    summary = summarise_changes(table)
    assert (summary["robots_before"], summary["robots_after"]) == (3, 4)
    assert summary["recovered"] == np.mean(table["success"])
    np.testing.assert_array_equal(np.isfinite(table["recovery_time"]), table["success"])
    assert np.nanmin(table["recovery_time"]) >= 5
    assert len(trajectory.poses) == summary["runs"] == 4


def test_strictness_is_reported_of_the_changed_team(addition):
    trajectory, table = addition
    changed = measure(trajectory.since(6.0))
    for name in ("strict", "strict_hold", "settled_speed"):
        np.testing.assert_array_equal(table[name], changed[name])
    np.testing.assert_array_equal(table["strict_recovery_time"], changed["strict_time"] - 6.0)
    np.testing.assert_array_equal(table["strict_before"], measure(_until(trajectory, 6.0))["strict"])
    summary = summarise_changes(table)
    assert summary["strict"] == np.mean(changed["strict"])
    assert summary["strict_before"] == np.mean(table["strict_before"])


def _until(trajectory, time):
    """The records before ``time``, and the earlier team at ``time``, in which nobody had moved since."""
    last = int(np.searchsorted(trajectory.time, time - 1e-6))
    earlier = trajectory.active[:, last - 1, :, None]
    poses = trajectory.poses[:, : last + 1].copy()
    poses[:, last] = np.where(earlier, poses[:, last], np.nan)
    active = trajectory.active[:, : last + 1].copy()
    active[:, last] = earlier[..., 0]
    return Trajectory(trajectory.time[: last + 1], poses, active, trajectory.commands[:, :last])


@pytest.mark.parametrize("distance", [0.6, 1.5])
def test_whoever_joins_keeps_the_prescribed_distance(distance):
    config = DynamicConfig(**(QUICK | {"distance": distance, "controller": "scan-pipeline"}))
    trajectory, table = run_changes(config, config.make_controller(), ChangedRuns("addition", 0, 4))
    at = int(np.searchsorted(trajectory.time, 6 - 1e-6))
    for run, robot in enumerate(table["changed_robot"]):
        apart = np.linalg.norm(trajectory.positions[run, at] - trajectory.positions[run, at, robot], axis=-1)
        assert max(0.5, 0.5 * distance) <= np.delete(apart, robot).min() <= 2.0 * distance


def test_runs_torn_apart_by_the_change_are_counted_apart(addition):
    table = {name: column.copy() for name, column in addition[1].items()}
    table["success"][:] = [True, True, False, False]
    table["connected_start"][:] = [True, True, True, False]
    summary = summarise_changes(table)
    assert summary["recovered"] == 0.5
    assert summary["connected"] == 0.75
    assert summary["recovered_connected"] == pytest.approx(2 / 3)


def test_results_are_kept_and_repeatable(tmp_path, console, addition):
    config = DynamicConfig(json=tmp_path / "out.json", parquet=tmp_path / "out.parquet", **QUICK)
    result = run_dynamic(config, console)
    written = json.loads((tmp_path / "out.json").read_text())
    assert [entry["change"] for entry in written["results"]] == ["addition", "removal"]
    assert written["results"][0]["recovered"] == result["results"][0]["recovered"]
    frame = pd.read_parquet(tmp_path / "out.parquet")
    assert len(frame) == 8
    np.testing.assert_array_equal(frame[frame.change == "addition"].formation_error, addition[1]["formation_error"])


def test_results_depend_neither_on_chunks_nor_on_threads(addition, removal, monkeypatch):
    monkeypatch.setattr(scenario, "ROBOTS_PER_CHUNK", 3)
    config = DynamicConfig(**(QUICK | {"threads": 2}))
    apart = dict(measure_changes(config, config.make_controller(), LocalEngine(2)))
    for change, (_, together) in (("addition", addition), ("removal", removal)):
        assert apart[change].keys() == together.keys()
        for name, column in together.items():
            np.testing.assert_array_equal(apart[change][name], column, err_msg=name)


def test_finished_additions_survive_an_interruption(tmp_path, console, monkeypatch):
    def interrupted(config, controller, runs, on_step=None):
        if runs.change == "removal":
            raise KeyboardInterrupt
        return run_changes(config, controller, runs, on_step)

    monkeypatch.setattr(dynamic, "run_changes", interrupted)
    config = DynamicConfig(json=tmp_path / "out.json", parquet=tmp_path / "out.parquet", threads=1, **QUICK)
    with pytest.raises(KeyboardInterrupt):
        run_dynamic(config, console)
    assert [entry["change"] for entry in json.loads((tmp_path / "out.json").read_text())["results"]] == ["addition"]
    assert pd.read_parquet(tmp_path / "out.parquet").change.tolist() == ["addition"] * 4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robots": 1}, "robots is 1"),
        ({"runs": 0}, "runs is 0"),
        ({"change_time": 14.0}, "change_time is 14"),
        ({"change_time": 4.9}, "change_time is 4.9"),
        ({"change_time": 9.1}, "change_time is 9.1"),
    ],
)
def test_bad_settings_are_refused(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        DynamicConfig(**(QUICK | changes))
