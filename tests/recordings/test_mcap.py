"""MCAP: another reader finds topics, counts and poses, and what is read back is the run."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from scipy.spatial import Delaunay

from tests.options import options, scenario
from triform.cli import main
from triform.experiments.evaluate import EvaluateConfig
from triform.recordings.description import RunSetting
from triform.recordings.kept import keep_runs
from triform.recordings.measure import MeasureConfig, run_measure
from triform.recordings.resample import read_recordings
from triform.types import ConfigurationError, TriformError

RECORDS = 61


@pytest.fixture
def written(tmp_path):
    chosen = scenario(duration=6.0, arena="pillars", distance=0.9)
    trajectory, table = chosen.run(chosen.sample_starts(5, 1, 3), "expert", 3)
    with keep_runs(tmp_path / "run.mcap") as writer:
        writer.add(trajectory, RunSetting.of(chosen, 5), table)
        writer.describe({"seed": 3})
    return tmp_path / "run.mcap", trajectory


def decoded(schema, data):
    """Decode a message by the definition that the file holds of it."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(data)


def messages(path, topic):
    with path.open("rb") as file:
        found = list(make_reader(file).iter_messages(topics=[topic]))
    return [
        (each.log_time, json.loads(each.data) if channel.message_encoding == "json" else decoded(schema, each.data))
        for schema, channel, each in found
    ]


def test_another_reader_finds_topics_counts_and_poses(written):
    path, trajectory = written
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        (about,) = [each.metadata for each in reader.iter_metadata()]
    counts = {summary.channels[key].topic: count for key, count in summary.statistics.channel_message_counts.items()}
    assert counts == {"/tf": RECORDS, "/formation": RECORDS, "/robots": RECORDS, "/measures": RECORDS, "/arena": 1}
    kinds = {each.topic: summary.schemas[each.schema_id].name for each in summary.channels.values() if each.schema_id}
    assert kinds["/tf"] == "foxglove.FrameTransforms"
    assert kinds["/formation"] == kinds["/arena"] == "foxglove.SceneUpdate"
    description = json.loads(about["description"])
    assert description["settings"] == {"seed": 3}
    assert description["runs"][0]["distance"] == 0.9
    transforms = messages(path, "/tf")
    assert [time for time, _ in transforms] == [100_000_000 * k for k in range(RECORDS)]
    for record in (0, -1):
        for robot, each in enumerate(transforms[record][1].transforms):
            x, y, heading = trajectory.poses[0, record, robot]
            assert (each.parent_frame_id, each.child_frame_id) == ("world", f"robot{robot}")
            assert (each.translation.x, each.translation.y) == (x, y)
            apart = 2 * math.atan2(each.rotation.z, each.rotation.w) - heading
            assert math.remainder(apart, math.tau) == pytest.approx(0, abs=1e-12)
    state = messages(path, "/robots")[7][1]["robots"][2]
    np.testing.assert_array_equal([state[name] for name in ("x", "y", "heading")], trajectory.poses[0, 7, 2])
    np.testing.assert_array_equal([state[name] for name in ("v_x", "v_y", "omega")], trajectory.commands[0, 7, 2])


def test_the_graph_is_drawn_by_the_length_of_its_edges(written):
    path, trajectory = written
    (entity,) = messages(path, "/formation")[-1][1].entities
    (lines,) = entity.lines
    ends = np.array([[point.x, point.y] for point in lines.points]).reshape(-1, 2, 2)
    places = trajectory.positions[0, -1]
    delaunay = {frozenset(pair) for a, b, c in Delaunay(places).simplices for pair in ((a, b), (b, c), (a, c))}
    # Of Delaunay's edges, those whose circle holds nobody else.
    expected = set()
    for pair in delaunay:
        one, other = places[list(pair)]
        rest = places[sorted(set(range(5)) - pair)]
        if (np.linalg.norm(rest - (one + other) / 2, axis=1) >= np.linalg.norm(one - other) / 2).all():
            expected.add(frozenset((tuple(one), tuple(other))))
    assert {frozenset(map(tuple, edge)) for edge in ends} == expected
    errors = np.abs(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) - 0.9) / 0.9
    red = np.array([colour.r for colour in lines.colors])[::2]
    assert len(lines.colors) == len(lines.points)
    assert (np.diff(red[np.argsort(errors)]) >= 0).all()
    (arena,) = messages(path, "/arena")[0][1].entities
    assert (len(arena.lines[0].points), len(arena.cylinders)) == (8, 4)


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**31), st.integers(2, 8), st.sampled_from([None, "join@6", "leave@6", "push@6"]))
def test_measures_of_what_is_read_back_are_those_of_the_run(tmp_path, seed, robots, event):
    chosen = scenario(duration=12.0, event=event)
    trajectory, table = chosen.run(chosen.sample_starts(robots, 1, seed), "expert", seed)
    with keep_runs(tmp_path / "run.mcap") as writer:
        writer.add(trajectory, RunSetting.of(chosen, trajectory.poses.shape[2]), table)
    found = run_measure(MeasureConfig((tmp_path / "run.mcap",))).runs
    for name, column in table.items():
        np.testing.assert_array_equal(found[name], column, err_msg=name)
    (recording,) = read_recordings(tmp_path / "run.mcap")
    np.testing.assert_array_equal(recording.trajectory.positions, trajectory.positions)
    apart = recording.trajectory.poses[..., 2] - trajectory.poses[..., 2]
    np.testing.assert_allclose(np.exp(1j * apart), np.where(np.isnan(apart), np.nan, 1), atol=1e-12)


def test_transforms_of_other_programs_are_a_recording(written, tmp_path):
    path, trajectory = written
    with path.open("rb") as old, (tmp_path / "other.mcap").open("wb") as new:
        writer = Writer(new)
        writer.start()
        channels = {}
        for schema, channel, message in make_reader(old).iter_messages(topics=["/tf"]):
            if not channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel("/poses", channel.message_encoding, kind)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.log_time)
        writer.finish()
    (recording,) = read_recordings(tmp_path / "other.mcap")
    assert recording.robots == tuple(f"robot{k}" for k in range(5))
    assert recording.setting is None
    np.testing.assert_allclose(recording.trajectory.positions, trajectory.positions, atol=1e-9)


def test_one_run_is_shown_and_several_are_refused_before_any_is_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["evaluate", "--controller", "expert", "--robots", "3", "--runs", "1", "--duration", "5"]
    assert main([*words, "--mcap", "run.mcap", "--keep", "run.parquet"]) == 0
    assert "wrote run.mcap" in capsys.readouterr().out
    both = [run_measure(MeasureConfig((tmp_path / name,))).runs for name in ("run.mcap", "run.parquet")]
    for name in set(both[0]) - {"recording"}:
        np.testing.assert_array_equal(both[0][name], both[1][name], err_msg=name)
    frames = scenario(duration=5.0)
    trajectory, table = frames.run(frames.sample_starts(3, 2, 3), "expert", 3)
    with pytest.raises(ConfigurationError, match="holds one run"), keep_runs(tmp_path / "two.mcap") as writer:
        writer.add(trajectory, RunSetting.of(frames, 3), table)
    assert not list(tmp_path.glob("*two*"))
    with pytest.raises(ConfigurationError, match="it holds one run"):
        options(EvaluateConfig, robots=(3,), runs=2, mcap=tmp_path / "run.mcap")
    with pytest.raises(ConfigurationError, match=r"ends in \.mcap"):
        options(EvaluateConfig, robots=(3,), runs=1, mcap=tmp_path / "run.parquet")


@pytest.mark.parametrize("keep", [0, 10, 0.5, -1])
def test_damaged_files_are_refused_in_a_sentence(written, keep):
    path, _ = written
    data = path.read_bytes()
    size = keep if isinstance(keep, int) else int(keep * len(data))
    path.write_bytes(data[:size])
    with pytest.raises(TriformError, match=r"^[^\n]*run\.mcap cannot be read[^\n]*$"):
        read_recordings(path)
