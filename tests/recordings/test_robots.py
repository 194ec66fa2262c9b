"""What emulated and real robots keep: what they recorded beside it."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from triform.cli import main
from triform.commands.drive import Drive
from triform.evaluation import Trajectory
from triform.evaluation.senses import SensesLog
from triform.recordings.kept import keep_runs, open_runs
from triform.recordings.resample import read_recordings
from triform.recordings.robots import with_senses, write_drive
from triform.types import ConfigurationError, Scan, ScanConfig, TriformError, View


def test_an_emulation_keeps_true_poses(tmp_path, capsys):
    kept, truth = tmp_path / "run.parquet", tmp_path / "true.csv"
    where = ["--address", "127.0.47.1", "--local-address", "127.0.48.1", "--arena", "room-6"]
    assert (
        main(["emulate", "--robots", "2", "--duration", "5.6", "--keep", str(kept), "--record", str(truth), *where])
        == 0
    )
    assert f"kept in {kept}" in capsys.readouterr().out.replace("\n", "")
    runs = open_runs(kept)
    written = pd.read_csv(truth)
    trajectory = runs.trajectory(0)
    np.testing.assert_allclose(np.repeat(trajectory.time, 2), written.time, atol=1e-6)
    np.testing.assert_allclose(trajectory.poses[0].reshape(-1, 3), written[["x", "y", "heading"]], atol=1e-6)
    assert (trajectory.commands == 0).all()
    assert runs.setting(0).arena.name == "room-6"
    (recording,) = read_recordings(kept)
    assert recording.whole["collision"].tolist() == [False]
    assert recording.whole["min_distance"][0] == np.linalg.norm(np.diff(trajectory.positions[0, 0], axis=0))
    np.testing.assert_array_equal(recording.trajectory.time, trajectory.time)


STEPS = """time,robot,x,y,heading,u_x,u_y,omega,scan_age,latency,fresh,late
1700000000.125000,3,nan,nan,nan,0.1,0.0,0.2,0.1,0.1,1,0
1700000000.250000,3,0.5,0.25,1.5,0.2,-0.1,0.0,0.1,0.1,1,0
1700000000.376000,3,0.52,0.24,1.5,0.0,0.0,0.0,0.1,0.1,1,0
"""


@pytest.fixture
def recorded(tmp_path):
    folder = tmp_path / "robot-3"
    folder.mkdir()
    (folder / "steps.csv").write_text(STEPS)
    (folder / "drive.json").write_text('{"settings": {"robot": 3}, "ended": "its time is over"}')
    return folder


def test_a_drive_keeps_odometry_and_says_that_it_is_that(recorded, tmp_path):
    config = Drive(record=recorded, keep=tmp_path / "run.parquet", footprint="circle:0.3", distance=0.8)
    with keep_runs(config.keep, source="odometry") as writer:
        write_drive(writer, recorded, config)
    runs = open_runs(config.keep)
    assert runs.description.source == "odometry"
    assert runs.description.settings == json.loads((recorded / "drive.json").read_text())
    assert (runs.setting(0).distance, runs.setting(0).footprint.label) == (0.8, "circle:0.3")
    trajectory = runs.trajectory(0)
    assert trajectory.active[0, :, 0].tolist() == [False, True, True]
    np.testing.assert_array_equal(trajectory.poses[0, 1:, 0], [[0.5, 0.25, 1.5], [0.52, 0.24, 1.5]])
    np.testing.assert_array_equal(trajectory.commands[0, :, 0], [[0.1, 0.0, 0.2], [0.2, -0.1, 0.0]])
    assert trajectory.time[0] == 1700000000.125


def views(robot, steps):
    """What a robot sees in some steps: a ray at 1 m and the number of the step, and itself at rest from step 1 on."""
    log = SensesLog()
    for step in range(steps):
        ranges = np.array([[[1.0, step, np.inf, np.nan]]], np.float32)
        known = {"noise": np.full((1, 1, 2), robot)} | ({"odometry": np.full((1, 1, 3), 0.1)} if step else {})
        log.add(View(Scan(ranges, ScanConfig(rays=4)), np.ones((1, 1), bool), float(step), **known))
    return log.senses


def test_a_drive_keeps_what_its_controller_saw_in_the_steps_that_are_written(recorded, tmp_path):
    config = Drive(record=recorded, keep=tmp_path / "run.parquet", scans=True, lidar_model="ld19")
    with keep_runs(config.keep, source="odometry") as writer:
        write_drive(writer, recorded, config, views(3, 5))
    runs = open_runs(config.keep)
    (lidar,) = runs.description.lidars
    assert (lidar.scan.rays, lidar.period, lidar.rolling) == (4, config.model.period, True)
    (senses,) = runs.trajectory(0, scans=True).senses
    # It sees though its odometry is not known yet.
    assert senses.active.all()
    np.testing.assert_array_equal(senses.ranges[0, :, 0], [[1, k, np.inf, np.nan] for k in range(3)])
    seen = [senses.view(record, 0.0) for record in range(3)]
    assert seen[0].odometry is None
    np.testing.assert_array_equal(seen[2].odometry[0, 0], [0.1, 0.1, 0.1])
    np.testing.assert_array_equal(seen[0].noise[0, 0], [3, 3])


def test_every_record_of_an_emulation_gets_the_newest_step_of_each_drive():
    def driven(robot, times):
        time, still = np.array(times), np.zeros((1, len(times), 1, 3))
        return Trajectory(time, still, np.ones((1, len(times), 1), bool), still[:, 1:], views(robot, len(times)))

    still = np.zeros((1, 4, 2, 3))
    run = Trajectory(np.arange(4.0), still, np.ones((1, 4, 2), bool), still[:, 1:])
    drives = [driven(0, [10.05, 11.0, 11.5]), driven(1, [9.0, 9.5, 12.95, 13.1])]
    (senses,) = with_senses(run, 10.0 + np.arange(4), drives).senses
    assert senses.ranges[0, :, 0, 1].tolist() == [0, 1, 2, 2]
    assert senses.ranges[0, :, 1, 1].tolist() == [1, 1, 1, 2]
    assert senses.noise[0, :, :, 0].tolist() == [[0, 1]] * 4


def test_a_drive_that_recorded_nothing_keeps_nothing(recorded, tmp_path):
    (recorded / "steps.csv").write_text("\n".join(STEPS.split("\n")[:2]) + "\n")
    with (
        pytest.raises(TriformError, match="less than two steps"),
        keep_runs(tmp_path / "run.parquet", source="odometry") as writer,
    ):
        write_drive(writer, recorded, Drive(record=recorded))
    assert not (tmp_path / "run.parquet").exists()
    with pytest.raises(ConfigurationError, match="keep is given without record"):
        Drive(keep=tmp_path / "run.parquet")
    with pytest.raises(ConfigurationError, match="scans is given without keep or mcap"):
        Drive(record=recorded, scans=True)
