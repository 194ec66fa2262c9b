"""What emulated and real robots keep: what they recorded beside it."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from triform.cli import main
from triform.commands.drive import Drive
from triform.recordings.kept import keep_runs, open_runs
from triform.recordings.resample import read_recordings
from triform.recordings.robots import write_drive
from triform.types import ConfigurationError, TriformError


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
