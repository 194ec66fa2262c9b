from __future__ import annotations

import functools
import io

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.evaluation import Scenario, measure
from triform.evaluation.rollout import Trajectory
from triform.experiments.reproduce import trajectory_table
from triform.recordings.formats import RawRun, make_track
from triform.recordings.resample import LONGEST_GAP, even_out, read_recordings
from triform.report.tables import write_parquet
from triform.types import TriformError


@functools.cache
def driven(robots=4, runs=2):
    """Runs of the built-in world, which record at 8 Hz."""
    scenario = Scenario(profile="hardware", duration=8.0)
    return scenario.run(scenario.sample_starts(robots, runs, 3), "expert-sensed", seed=3)[0]


def rows_of(trajectory):
    """The runs as a table with one row per run, robot and moment."""
    runs, records, robots = trajectory.active.shape
    run, record, robot = (index.ravel() for index in np.indices((runs, records, robots)))
    poses = trajectory.poses.reshape(-1, 3)
    columns = {"run": run, "time": trajectory.time[record], "robot": robot}
    return pd.DataFrame(columns | {name: poses[:, i] for i, name in enumerate(("x", "y", "heading"))})


def assert_measures_are_those_of(recordings, trajectory, tolerance=1e-9):
    expected = measure(trajectory)
    assert len(recordings) == len(trajectory.poses)
    for run, recording in enumerate(recordings):
        found = measure(recording.trajectory)
        for name, column in expected.items():
            np.testing.assert_allclose(found[name][0], column[run], rtol=0, atol=tolerance, err_msg=name)


def test_arrays_measure_as_the_runs_that_they_hold(tmp_path):
    trajectory = driven()
    np.save(tmp_path / "many.npy", trajectory.poses)
    np.save(tmp_path / "one.npy", trajectory.poses[1])
    assert_measures_are_those_of(read_recordings(tmp_path / "many.npy", rate=8), trajectory)
    assert_measures_are_those_of(read_recordings(tmp_path / "one.npy", rate=8), trajectory.run(1))


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_tables_measure_as_the_runs_that_they_hold(tmp_path, suffix):
    trajectory = driven()
    table = rows_of(trajectory)
    # Any order of rows and columns, rows twice, columns of others, clocks that do not start at zero.
    table = pd.concat([table, table.iloc[::7]]).sample(frac=1, random_state=1)
    table["battery"] = "full"
    table["time"] += 1000.0
    table = table[["heading", "battery", "robot", "x", "time", "run", "y"]]
    path = tmp_path / f"runs.{suffix}"
    if suffix == "csv":
        table.to_csv(path, index=False)
    else:
        table.to_parquet(path)
    recordings = read_recordings(path)
    assert_measures_are_those_of(recordings, trajectory)
    assert [recording.label for recording in recordings] == [f"{path}, run 0", f"{path}, run 1"]
    np.testing.assert_allclose(recordings[1].trajectory.poses[0], trajectory.poses[1], atol=1e-9)
    np.testing.assert_allclose(recordings[1].trajectory.time, trajectory.time, atol=1e-9)


def test_trajectories_of_the_paper_page_are_recordings(tmp_path):
    trajectories = [driven(4).run(0), driven(5, 1)]
    write_parquet(tmp_path / "fig3.parquet", trajectory_table(trajectories))
    recordings = read_recordings(tmp_path / "fig3.parquet")
    for recording, trajectory in zip(recordings, trajectories, strict=True):
        assert_measures_are_those_of([recording], trajectory)


def test_headings_of_columns_may_stand_after_empty_lines_with_spaces_and_a_byte_order_mark(tmp_path):
    lines = ["", " time, robot ,x,y , heading"]
    lines += [f"{k / 10}, {name},{x}, 0.5,0" for k in range(61) for x, name in enumerate(("north", "south"))]
    (tmp_path / "run.csv").write_text("\n".join(lines), encoding="utf-8-sig")
    (recording,) = read_recordings(tmp_path / "run.csv")
    assert recording.robots == ("north", "south")
    np.testing.assert_array_equal(recording.trajectory.poses[0, -1], [[0, 0.5, 0], [1, 0.5, 0]])


@pytest.mark.parametrize("missing", [np.nan, None])
def test_a_robot_that_comes_or_goes_is_absent_and_not_in_a_gap(tmp_path, missing):
    trajectory = driven()
    poses, active = trajectory.poses.copy(), trajectory.active.copy()
    active[0, :20, 2] = False
    active[0, 40:, 0] = False
    poses[~active] = np.nan
    changed = Trajectory(trajectory.time, poses, active, trajectory.commands).run(0)
    table = rows_of(changed).drop(columns="run")
    if missing is None:
        table = table.dropna()
    table.to_csv(tmp_path / "run.csv", index=False)
    (recording,) = read_recordings(tmp_path / "run.csv")
    assert_measures_are_those_of([recording], changed)
    np.testing.assert_array_equal(recording.trajectory.active[0], active[0])
    assert [sentence.split(": ")[-1] for sentence in recording.changes] == [
        "robot 0 goes at 4.88 s",
        "robot 2 comes at 2.50 s",
    ]


def test_start_and_end_cut_and_times_count_from_the_cut(tmp_path):
    trajectory = driven()
    rows_of(trajectory).to_csv(tmp_path / "runs.csv", index=False)
    recordings = read_recordings(tmp_path / "runs.csv", start=1.0, end=7.5)
    later = trajectory.since(1.0)
    cut = Trajectory(later.time[:53] - 1.0, later.poses[:, :53], later.active[:, :53], later.commands[:, :52])
    assert cut.time[-1] == 6.5
    assert_measures_are_those_of(recordings, cut)


def moving(time, robot):
    """Poses of a robot that moves on a straight line and turns steadily, several times."""
    poses = np.stack([robot + 0.1 * time, 0.2 * time - robot, 1.7 * time + robot], axis=1)
    poses[:, 2] = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return poses


def turned(first, second):
    return np.abs((first - second + np.pi) % (2 * np.pi) - np.pi)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_steady_motion_survives_gaps_and_uneven_clocks(seed, jitter):
    rng = np.random.default_rng(seed)
    tracks = {}
    for robot in range(3):
        time = np.arange(0, 8.01, 0.1) + (rng.uniform(0, 0.09, 81) if jitter else 0)
        kept = np.ones(81, dtype=bool)
        # Three records missing in a row make a gap of at most 0.4 s, and 0.09 s more between uneven clocks.
        for first in rng.choice(np.arange(1, 75, 5), 6, replace=False):
            kept[first : first + rng.integers(1, 4)] = False
        order = rng.permutation(np.flatnonzero(kept))
        tracks[str(robot)] = make_track("robot", 1e9 + time[order], moving(time, robot)[order])
    begin = max(float(track.time[0]) for track in tracks.values()) - 1e9
    recording = even_out(RawRun("run", tracks))
    trajectory = recording.trajectory
    assert trajectory.active.all()
    assert recording.changes == ()
    assert np.ptp(np.diff(trajectory.time)) < 1e-9
    assert trajectory.period == pytest.approx(0.1, rel=0.3)
    for robot in range(3):
        expected = moving(begin + trajectory.time, robot)
        np.testing.assert_allclose(trajectory.poses[0, :, robot, :2], expected[:, :2], atol=1e-6)
        assert turned(trajectory.poses[0, :, robot, 2], expected[:, 2]).max() < 1e-5


def test_rounded_times_neither_gain_nor_lose_records():
    time = np.arange(36_000) / 120
    kept = np.delete(np.arange(len(time)), slice(500, 530))
    tracks = {str(robot): make_track("robot", np.round(time, 6)[kept], moving(time, robot)[kept]) for robot in range(2)}
    trajectory = even_out(RawRun("run", tracks)).trajectory
    np.testing.assert_allclose(trajectory.time, time, rtol=0, atol=1e-6)
    np.testing.assert_allclose(trajectory.positions[0, :, 1], moving(time, 1)[:, :2], atol=1e-6)


def test_bursts_of_records_are_evened_out_at_ten_hertz():
    time = np.add.outer(np.arange(0, 8.01, 0.1), 1e-5 * np.arange(4)).ravel()
    tracks = {str(robot): make_track("robot", time, moving(time, robot)) for robot in range(2)}
    assert even_out(RawRun("run", tracks)).trajectory.period == pytest.approx(0.1, rel=1e-3)


def lines_of(time, robots=2):
    return [f"{t:g},{robot},{robot},0,0" for t in time for robot in range(robots)]


TIMES = np.arange(0, 6.01, 0.1)
HEADINGS = "time,robot,x,y,heading"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "there is no time"),
        ("time;robot;x;y;heading\n0;0;0;0;0", "has semicolons between its columns; commas are needed"),
        ("time\trobot\tx\ty\theading\n0\t0\t0\t0\t0", "has tabs between its columns; commas are needed"),
        ("robot,place\n0,0", "needs the columns time, robot, x, y, heading, each once"),
        (
            "\n".join(
                [HEADINGS, *(f"{t:g},{robot},{1000 * robot + 2000 * t:g},0,0" for t in TIMES for robot in (0, 1))]
            ),
            "robot 0 moves at 2e.03 m/s by its positions and times; metres and seconds are needed",
        ),
        (
            "\n".join([HEADINGS, *(f"{t:g},{robot},{robot},0,{170 + robot}" for t in TIMES for robot in (0, 1))]),
            "headings such as 171; they look like degrees, radians are needed",
        ),
        ("time,robot,x,y\n0,0,0,0", "there is no heading"),
        ("time,robot,x,x,y,heading\n0,0,0,0,0,0", "there are several x"),
        (HEADINGS, "holds no poses"),
        (HEADINGS + "\n\n", "holds no poses"),
        (HEADINGS + "\n0,0,,,\n", "holds no poses"),
        (HEADINGS + "\n0,0,0,0,0\n0.1,0,left,0,0", "line 3, column x: 'left' is not a number"),
        (HEADINGS + "\n0,0,0,0,0\n\n,0,1,0,0", "line 4, column time, is empty"),
        (HEADINGS + "\n0,,0,0,0", "line 2, column robot, is empty"),
        (HEADINGS + "\ninf,0,0,0,0", "row 1, column time: inf is not a finite number"),
        (HEADINGS + "\n0,0,0,0,0\n0.1,0,0,0", "line 3: 4 columns; 5 are needed"),
        ("\n".join([HEADINGS, *lines_of(TIMES[:30])]), "lasts 2.9 s.*at least that long"),
        ("\n".join([HEADINGS, *lines_of([0.0])]), "no two records"),
        ("\n".join([HEADINGS, *lines_of(TIMES, 1)]), "never two robots"),
        (
            "\n".join([HEADINGS, *lines_of(TIMES), *lines_of(TIMES + 7)]),
            "robot 0 has no record from 6.00 s to 7.00 s; gaps of at most 0.5 s are filled",
        ),
        ("\n".join([HEADINGS, *lines_of(TIMES), "0.5,1,3,0,0"]), "robot 1 is at two places at time 0.5 s"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_one_sentence(tmp_path, text, says):
    path = tmp_path / "run.csv"
    path.write_text(text)
    with pytest.raises(TriformError, match=says) as caught:
        read_recordings(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "latin-1"])
def test_names_of_robots_in_any_encoding_stay_apart(tmp_path, encoding):
    lines = [f"{t:g},{name},{x},0,0" for t in TIMES for x, name in enumerate(("grün", "blau", "weiß"))]
    (tmp_path / "run.csv").write_bytes("\n".join([HEADINGS, *lines]).encode(encoding))
    (recording,) = read_recordings(tmp_path / "run.csv")
    assert recording.robots == ("blau", "grün", "weiß")


def test_gaps_are_bridged_up_to_the_longest_one(tmp_path):
    for gap, fits in ((LONGEST_GAP, True), (LONGEST_GAP + 0.1, False)):
        times = np.concatenate([TIMES, TIMES[-1] + gap + TIMES])
        (tmp_path / "run.csv").write_text("\n".join([HEADINGS, *lines_of(times)]))
        if fits:
            assert read_recordings(tmp_path / "run.csv")[0].trajectory.active.all()
        else:
            with pytest.raises(TriformError, match="has no record"):
                read_recordings(tmp_path / "run.csv")


def array_header(shape):
    """The beginning of an .npy file; the numbers are missing."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("none.csv", None, "cannot be read: no such file"),
        ("run.txt", b"", "ends in '.txt'"),
        ("image.csv", b"\x89PNG\r\n\x1a\n\xff\xfe", "cannot be read: it is no text"),
        ("run.parquet", b"no table", "cannot be read"),
        ("run.npy", b"no array", "not an .npy file"),
        ("run.npy", b"\x93NUMPY\x01\x00\x12\x00{'shape': (1, 2, 3 ", "not an .npy file"),
        ("run.npy", array_header((10**15, 2, 3)), "not an .npy file"),
        ("run.csv", b"a" * 200_000, "field larger than field limit"),
        ("run.csv", b"time,robot,x,y,heading\n" + b"a" * 200_000 + b",0,0,0,0", "field larger than field limit"),
    ],
)
def test_foreign_files_are_refused(tmp_path, name, content, says):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(TriformError, match=says) as caught:
        read_recordings(tmp_path / name, rate=10)
    assert "\n" not in str(caught.value)


def test_arrays_of_other_shapes_types_or_without_a_rate_are_refused(tmp_path):
    path = tmp_path / "run.npy"
    for values, says in (
        (np.zeros((9, 3)), r"float64 of shape \(9, 3\)"),
        (np.full((60, 2, 3), "a"), "poses of shape"),
        (np.array([{"a": 1}]), "not an .npy file of numbers"),
    ):
        np.save(path, values, allow_pickle=True)
        with pytest.raises(TriformError, match=says):
            read_recordings(path, rate=10)
    with pytest.raises(TriformError, match="rate"):
        read_recordings(path)


@pytest.mark.parametrize(
    ("column", "values", "says"),
    [
        ("x", ["left", "right"], "column x, holds .*string; numbers are"),
        ("robot", [None, "b"], "row 1, column robot, is"),
    ],
)
def test_parquet_of_other_types_is_refused(tmp_path, column, values, says):
    table = pd.DataFrame({"time": [0.0, 0.1], "robot": ["a", "b"], "x": 0.0, "y": 0.0, "heading": 0.0})
    table[column] = values
    table.to_parquet(tmp_path / "run.parquet")
    with pytest.raises(TriformError, match=says):
        read_recordings(tmp_path / "run.parquet")
