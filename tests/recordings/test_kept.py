"""Kept runs: what is read is what was written, and its measures are those of the run, to the bit."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from tests.options import options, scenario
from triform.evaluation import Trajectory
from triform.experiments.evaluate import EvaluateConfig, run_evaluate
from triform.recordings.description import RunSetting
from triform.recordings.kept import KEY, keep_runs, open_runs
from triform.recordings.measure import MeasureConfig, run_measure
from triform.recordings.resample import read_recordings
from triform.simulation import Arena, Footprint
from triform.types import TriformError

EVENTS = st.sampled_from([None, "join@6", "leave@6", "push@6", "stuck", "meet"])


def same(found, wanted):
    assert set(found) == set(wanted)
    for name, column in wanted.items():
        assert found[name].dtype.kind == column.dtype.kind, name
        np.testing.assert_array_equal(found[name], column, err_msg=name)


def same_trajectories(found, wanted):
    for name in ("time", "poses", "active", "commands"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.integers(0, 2**31),
    st.integers(1, 40),
    st.integers(1, 3),
    EVENTS,
    st.sampled_from(["expert", "triangulating"]),
    st.sampled_from(["ideal", "hardware"]),
    st.sampled_from([0.6, 1.0]),
)
def test_runs_and_their_measures_are_kept_to_the_bit(
    tmp_path, seed, robots, runs, event, controller, profile, distance
):
    path = tmp_path / "runs.parquet"
    robots = 9 if event == "meet" else robots
    chosen = scenario(duration=12.0, event=event, profile=profile, distance=distance)
    poses = chosen.sample_starts(robots, runs, seed)
    trajectory, table = chosen.run(poses, controller, seed)
    with keep_runs(path) as writer:
        writer.add(trajectory, RunSetting.of(chosen, trajectory.poses.shape[2]), table)
    kept = open_runs(path)
    assert len(kept) == runs
    for run in range(runs):
        same_trajectories(kept.trajectory(run), trajectory.run(run))
    found = run_measure(MeasureConfig((path,))).runs
    assert found.pop("recording").tolist() == [f"{path}, run {run}" for run in range(runs)]
    # One table for each team size, by growing size; a run is found by its number.
    order = np.argsort(found.pop("run"))
    same({name: column[order] for name, column in found.items()}, table)


def test_an_evaluation_keeps_what_it_measures(tmp_path, listener):
    config = options(
        EvaluateConfig, controller="expert-sensed", robots=(3, 9), runs=60, duration=5.0, seed=5, arena="room-6",
        keep=tmp_path / "deep" / "runs.parquet", threads=2,
    )  # fmt: skip
    wanted = run_evaluate(config, listener)
    assert "runs.parquet" in listener.console.file.getvalue()
    found = run_measure(MeasureConfig((config.keep,)))
    assert found.results == wanted.results
    assert found.config["distance"] == 1.0
    description = open_runs(config.keep).description
    assert [entry.start for entry in description.runs] == [*range(60)] * 2
    assert description.settings["controller_description"]["name"] == "expert-sensed"
    assert open_runs(config.keep).setting(0).arena.walls.shape == (4, 4)
    run_evaluate(options(EvaluateConfig, controller="expert-sensed", robots=(3, 9), runs=60, duration=5.0, seed=5,
                         arena="room-6", keep=tmp_path / "alone.parquet", threads=1), listener)  # fmt: skip
    frames = [pd.read_parquet(path) for path in (config.keep, tmp_path / "alone.parquet")]
    pd.testing.assert_frame_equal(*frames)
    assert list(frames[0].columns) == ["run", "time", "robot", "x", "y", "heading", "v_x", "v_y", "omega"]


def test_commands_are_those_from_a_record_to_the_next(tmp_path):
    path = tmp_path / "run.parquet"
    chosen = scenario(duration=6.0)
    trajectory, table = chosen.run(chosen.sample_starts(4, 1, 3), "expert", 3)
    with keep_runs(path) as writer:
        writer.add(trajectory, RunSetting.of(chosen, 4), table)
    frame = pd.read_parquet(path)
    one = frame[frame.robot == 2]
    np.testing.assert_array_equal(one.v_x.to_numpy()[:-1], trajectory.commands[0, :, 2, 0])
    assert one[["v_x", "v_y", "omega"]].iloc[-1].isna().all()
    # Any reader of the table sees the poses, and so does the one that knows nothing of the metadata.
    frame.to_csv(tmp_path / "run.csv", index=False)
    (other,) = read_recordings(tmp_path / "run.csv")
    np.testing.assert_allclose(other.trajectory.positions, trajectory.positions, atol=1e-12)


@pytest.fixture
def touching(tmp_path):
    """Two robots that pass each other within a footprint's width between two records, along a wall."""
    time = np.arange(0, 6.05, 0.1)
    poses = np.zeros((1, len(time), 2, 3))
    poses[0, :, 0, 0], poses[0, :, 1, 0], poses[0, :, 1, 1] = time - 3.05, 3.05 - time, 0.25
    run = Trajectory(time, poses, np.ones(poses.shape[:3], bool), np.zeros((1, len(time) - 1, 2, 3)))
    setting = RunSetting(1.0, (Footprint.circle(0.25), Footprint.box(0.2, 0.3)), Arena.room(6.0, 6.0))
    measures = {
        name: np.array([value]) for name, value in (("min_distance", 0.25), ("collision", True), ("hit_arena", False))
    }
    with keep_runs(tmp_path / "run.parquet") as writer:
        writer.add(run, setting, measures)
    return tmp_path / "run.parquet"


def test_contacts_are_those_of_the_run_unless_something_else_is_asked_for(touching):
    def measured(**changes):
        row = run_measure(MeasureConfig((touching,), **changes)).runs
        return row["collision"].item(), row["hit_arena"].item(), row["min_distance"].item()

    assert measured() == (True, False, 0.25)
    assert measured(distance=1.5) == (True, False, 0.25)
    # At the records the circles of this diameter do not touch, but stand out of the room at the ends.
    assert measured(footprint="circle:0.1")[:2] == (False, True)
    assert measured(start=0.1, footprint="circle:0.1")[0] is False
    # Cut, the run is what its records are.
    assert measured(start=0.5)[2] == pytest.approx(np.hypot(0.1, 0.25))


def test_runs_with_and_without_an_interruption_are_measured_apart(tmp_path):
    paths = []
    for event in (None, "leave@6"):
        paths.append(tmp_path / f"{event}.parquet")
        chosen = scenario(duration=12.0, event=event)
        trajectory, table = chosen.run(chosen.sample_starts(4, 1, 3), "expert", 3)
        with keep_runs(paths[-1]) as writer:
            writer.add(trajectory, RunSetting.of(chosen, 4), table)
    with pytest.raises(TriformError, match="measure them apart"):
        run_measure(MeasureConfig(tuple(paths)))


def test_a_failed_evaluation_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "runs.parquet"
    path.write_bytes(b"before")

    def broken(self, *given):
        raise TriformError("the disk is full")

    monkeypatch.setattr("triform.recordings.kept.RunWriter.add", broken)
    with pytest.raises(TriformError, match="disk is full"):
        run_evaluate(options(EvaluateConfig, controller="expert", robots=(3,), runs=2, duration=5.0, keep=path))
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_killed_evaluation_leaves_no_broken_file(tmp_path):
    chosen = {"controller": "expert", "robots": 30, "runs": 3000, "threads": 1, "keep": tmp_path / "runs.parquet"}
    words = [word for name, value in chosen.items() for word in (f"--{name}", str(value))]
    code = "import sys; from triform.cli import main; sys.exit(main(sys.argv[1:]))"
    path = tmp_path / "runs.parquet"
    process = subprocess.Popen([sys.executable, "-c", code, "evaluate", *words], stdout=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while not any(each.stat().st_size > 100_000 for each in tmp_path.glob(".runs.parquet.*.tmp")):
            assert time.monotonic() < deadline
            assert process.poll() is None
            time.sleep(0.02)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert not path.exists()
    run_evaluate(options(EvaluateConfig, controller="expert", robots=(3,), runs=1, duration=5.0, keep=path))
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda table, text: (table.slice(1), text), "one row for each record and robot"),
        (lambda table, text: (table.take(np.arange(len(table))[::-1]), text), "one row for each record and robot"),
        (lambda table, text: (table.drop_columns(["omega"]), text), "its rows are not those of its 1 runs"),
        (lambda table, text: (table, b"{"), "cannot be read"),
        (lambda table, text: (table, b'{"format": 2}'), "in format 2; this version reads format 1"),
        (lambda table, text: (table, b'{"format": 1}'), "must hold exactly the values"),
        (lambda table, text: (table, text.replace(b'"circle:0.25"', b'"moon"')), "cannot be read: footprint is 'moon'"),
        (
            lambda table, text: (
                table.set_column(3, "x", pa.array([None, *table["x"].to_pylist()[1:]], pa.float64())),
                text,
            ),
            "a pose is not whole",
        ),
    ],
)
def test_a_file_that_was_changed_is_refused_in_a_sentence(touching, damage, says):
    table, text = damage(parquet.read_table(touching), parquet.read_metadata(touching).metadata[KEY])
    parquet.write_table(table.replace_schema_metadata({KEY: text}), touching)
    with pytest.raises(TriformError, match=f"^[^\n]*{says}[^\n]*$"):
        read_recordings(touching)
