"""Scans in kept runs and in MCAP: what is read back is what the controllers saw, so they decide the same again."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import shapely
from pyarrow import parquet

from tests.options import options, scenario
from tests.recordings.test_mcap import messages
from triform.control import weights_folder
from triform.experiments.evaluate import EvaluateConfig, run_evaluate
from triform.figures.style import footprint_outlines
from triform.geometry import body_to_world
from triform.perception import occupancy_maps
from triform.policy import read_spec
from triform.recordings.description import RunSetting
from triform.recordings.kept import COLUMNS, KEY, keep_runs, open_runs
from triform.recordings.measure import MeasureConfig, run_measure
from triform.simulation import cast_scans
from triform.types import ConfigurationError, Scan, TriformError

DOCS = Path(__file__).parents[2] / "docs" / "recordings.md"


def sensed(robots, runs=1, controller="scan-pipeline", duration=5.0, **changes):
    """A scenario, what happened in its runs with scans, and their measures."""
    chosen = scenario(duration=duration, **changes)
    return chosen, *chosen.run(chosen.sample_starts(robots, runs, 3), controller, 3, scans=True)


def kept(path, chosen, trajectory, table):
    with keep_runs(path) as writer:
        writer.add(trajectory, RunSetting.of(chosen, trajectory.poses.shape[2]), table)
    return path


def same_senses(found, wanted):
    for own, other in zip(found, wanted, strict=True):
        assert own.scan == other.scan
        for name in ("active", "ranges", "noise", "odometry"):
            np.testing.assert_array_equal(getattr(own, name), getattr(other, name), err_msg=name)
        assert (own.intensities is None) == (other.intensities is None)
        if own.intensities is not None:
            # Of what is not there nothing is written.
            there = own.active[..., None] & np.isfinite(own.ranges)
            np.testing.assert_array_equal(own.intensities[there], np.asarray(other.intensities)[there])


@pytest.mark.parametrize(
    ("robots", "changes"),
    [
        (4, {"profile": "hardware"}),
        (3, {"event": "join@6", "duration": 12.0}),
        (3, {"profile": "hardware", "min_intensity": 200.0}),
        (3, {"profile": "turtlebot4:1 hardware:2", "duration": 6.0}),
    ],
)
def test_controllers_decide_the_same_again_from_what_is_read_back(tmp_path, robots, changes):
    chosen, trajectory, table = sensed(robots, 2, "policy", **changes)
    path = kept(tmp_path / "runs.parquet", chosen, trajectory, table)
    runs = open_runs(path)
    assert runs.has_scans
    for run in range(2):
        found = runs.trajectory(run, scans=True)
        same_senses(found.senses, trajectory.run(run).senses)
        assert runs.trajectory(run).senses == ()
        if len(found.senses) > 1:
            assert [each.scan.rays for each in found.senses] == [e.lidar.scan.rays for e in chosen.team.profiles]
            continue
        driver = chosen.make_controller("policy")
        for record, time in enumerate(found.time[:-1].tolist()):
            command = driver.command(found.senses[0].view(record, time))
            there = found.active[0, record]
            # What an event changes at a record comes before the command.
            np.testing.assert_array_equal(command[0, there], found.commands[0, record, there])


def test_scans_show_what_stood_around_their_robots(tmp_path):
    chosen, trajectory, table = sensed(4, arena="room-6")
    found = open_runs(kept(tmp_path / "runs.parquet", chosen, trajectory, table)).trajectory(0, scans=True)
    (senses,) = found.senses
    footprint, room = chosen.robot.footprint, chosen.surroundings
    for record in (0, 23, -1):
        exact = cast_scans(found.poses[:, record], found.active[:, record], footprint, room, senses.scan)
        np.testing.assert_allclose(senses.ranges[:, record], exact, atol=1e-6)


def test_measures_and_other_columns_are_those_without_scans(tmp_path, listener):
    given = {"controller": "scan-pipeline", "robots": (3,), "runs": 90, "duration": 5.0, "seed": 5}
    wanted = run_evaluate(options(EvaluateConfig, keep=tmp_path / "plain.parquet", **given), listener)
    for threads, name in ((1, "one"), (2, "two")):
        path = tmp_path / f"{name}.parquet"
        run_evaluate(options(EvaluateConfig, keep=path, scans=True, threads=threads, **given), listener)
    assert (tmp_path / "one.parquet").read_bytes() == (tmp_path / "two.parquet").read_bytes()
    assert run_measure(MeasureConfig((path,))).results == wanted.results
    plain, table = parquet.read_table(tmp_path / "plain.parquet"), parquet.read_table(path)
    assert plain.column_names == list(COLUMNS)
    assert table.select(list(COLUMNS)).equals(plain)
    assert b"lidars" not in parquet.read_metadata(tmp_path / "plain.parquet").metadata[KEY]


def test_scans_without_a_file_are_refused():
    with pytest.raises(ConfigurationError, match=r"^scans is given without keep or mcap"):
        options(EvaluateConfig, scans=True)


def test_a_file_holds_scans_of_all_of_its_runs(tmp_path):
    chosen, trajectory, table = sensed(2)
    with (
        pytest.raises(ConfigurationError, match="scans of all of its runs, or of none"),
        keep_runs(tmp_path / "runs.parquet") as writer,
    ):
        [writer.add(each, RunSetting.of(chosen, 2), table) for each in (trajectory, replace(trajectory, senses=()))]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda table: table.drop_columns(["odometry_x"]), "its rows are not those of its 1 runs"),
        (lambda table: table.set_column(9, "lidar", pa.array([3] * len(table), pa.int32())), "has one LiDAR of the 1"),
        (
            lambda table: table.set_column(15, "ranges", pa.array([[1.0]] * len(table), pa.list_(pa.float32()))),
            "another number of values than its LiDAR has rays",
        ),
    ],
)
def test_damaged_scans_are_refused_in_a_sentence_and_the_rest_is_read(tmp_path, change, says):
    path = kept(tmp_path / "runs.parquet", *sensed(2))
    wanted = open_runs(path).trajectory(0)
    metadata = {KEY: parquet.read_metadata(path).metadata[KEY]}
    parquet.write_table(change(parquet.read_table(path)).replace_schema_metadata(metadata), path)
    with pytest.raises(TriformError, match=f"^[^\n]*{says}[^\n]*$"):
        open_runs(path).trajectory(0, scans=True)
    if "rows" not in says:
        np.testing.assert_array_equal(open_runs(path).trajectory(0).poses, wanted.poses)


def test_the_snippet_of_the_docs_finds_what_a_robot_saw(tmp_path, monkeypatch):
    chosen, trajectory, table = sensed(3)
    kept(tmp_path / "runs.parquet", chosen, trajectory, table)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"(?:^    .*\n|^\n)+", DOCS.read_text(), re.MULTILINE)
    (snippet,) = [block for block in blocks if "angle_min" in block]
    names: dict[str, object] = {}
    exec(re.sub(r"^    ", "", snippet, flags=re.MULTILINE), names)
    points = np.stack([names["x"], names["y"]], axis=1)
    others = [
        shapely.Polygon(each) for each in footprint_outlines(trajectory.poses[0, -1], [chosen.robot.footprint] * 3)
    ]
    apart = shapely.distance(shapely.MultiPolygon(others).boundary, shapely.points(points))
    assert len(points) > 10
    assert apart.max() < 1e-5


def test_another_reader_of_mcap_finds_scans_and_maps_where_the_robots_are(tmp_path):
    chosen, trajectory, table = sensed(4, profile="hardware", distance=0.8)
    path = kept(tmp_path / "run.mcap", chosen, trajectory, table)
    (senses,) = trajectory.senses
    outlines = [chosen.robot.footprint] * 4
    for robot in (0, 3):
        scans, grids = messages(path, f"/robot{robot}/scan"), messages(path, f"/robot{robot}/map")
        assert [time for time, _ in scans] == [time for time, _ in grids] == [125_000_000 * k for k in range(41)]
        for record in (0, 20, 40):
            shown = scans[record][1]
            assert shown.frame_id == f"robot{robot}"
            np.testing.assert_array_equal(np.array(shown.ranges, np.float32), senses.ranges[0, record, robot])
            assert (shown.start_angle, shown.end_angle) == (senses.scan.angles[0], senses.scan.angles[-1])
            # The default policy looks 3 d* far, in cells of 0.04 d*.
            view = Scan(senses.ranges[0, record, robot], replace(senses.scan, range_max=3 * 0.8))
            rules = replace(read_spec(weights_folder(None)).map, cell=0.04 * 0.8)
            grid = grids[record][1]
            cells = np.frombuffer(grid.data, np.uint8).reshape(-1, grid.row_stride)
            moved = senses.odometry[0, record, robot]
            np.testing.assert_array_equal(cells.T, occupancy_maps(view, rules, None if np.isnan(moved[0]) else moved))
            assert (grid.frame_id, grid.column_count, grid.cell_size.x) == (f"robot{robot}", rules.size, 0.04 * 0.8)
        # Seen through its frame, a scan lies on the others' outlines, and so do the occupied cells.
        pose = trajectory.poses[0, 40, robot]
        others = [each for k, each in enumerate(footprint_outlines(trajectory.poses[0, 40], outlines)) if k != robot]
        bodies = shapely.MultiPolygon([shapely.Polygon(each) for each in others])
        ranges, turned = np.array(shown.ranges), 2 * np.arctan2(shown.pose.orientation.z, shown.pose.orientation.w)
        angles = shown.start_angle + np.arange(len(ranges)) * (shown.end_angle - shown.start_angle) / (len(ranges) - 1)
        near = np.isfinite(ranges)
        points = ranges[near, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)[near]
        points = body_to_world(points, turned) + [shown.pose.position.x, shown.pose.position.y]
        columns, rows = np.nonzero(cells.T)
        middles = (np.stack([columns, rows], axis=1) + 0.5) * grid.cell_size.x
        middles += [grid.pose.position.x, grid.pose.position.y]
        for places, allowed in ((points, 0.06), (middles, 0.1)):
            apart = shapely.distance(bodies, shapely.points(pose[:2] + body_to_world(places, pose[2])))
            assert len(places) > 5
            assert np.quantile(apart, 0.95) < allowed
