from __future__ import annotations

import json
from contextlib import contextmanager

import numpy as np
import pandas as pd
import pytest

from tests.options import options
from triform.evaluation import Scenario
from triform.evaluation import runs as runs_module
from triform.evaluation import scenario as scenario_module
from triform.evaluation.runs import chunks
from triform.experiments.evaluate import EvaluateConfig, evaluate, run_evaluate
from triform.experiments.grid import Cell
from triform.simulation import sample_starts, world_seeds
from triform.types import ConfigurationError, TriformError

QUICK = {"controller": "expert-sensed", "robots": (3, 4), "runs": 3, "duration": 6.0, "seed": 5}
PROMISED = {
    "robots", "runs", "success", "success_sensed", "strict", "strict_sensed", "formation_error_median",
    "formation_error_p95", "converge_time_median", "compactness_mean", "min_distance", "collision",
}  # fmt: skip


def test_files_hold_the_promised_form_and_every_run(tmp_path, listener):
    config = options(EvaluateConfig, json=tmp_path / "deep" / "out.json", **QUICK)
    evaluation = run_evaluate(config, listener)
    written = json.loads((tmp_path / "deep" / "out.json").read_text())
    assert set(written) >= {"config", "wall_seconds", "results"}
    assert written["config"]["seed"] == 5
    assert written["config"]["controller_description"]["name"] == "expert-sensed"
    assert [result["robots"] for result in written["results"]] == [3, 4]
    for result in written["results"]:
        assert set(result) >= PROMISED
    frame = pd.read_parquet(tmp_path / "deep" / "out.parquet")
    assert len(frame) == 6
    assert frame.run.tolist() == [0, 1, 2] * 2
    assert written["results"][1]["success"] == frame[frame.robots == 4].success.mean()
    np.testing.assert_array_equal(frame.formation_error, evaluation.runs["formation_error"])
    shown = listener.console.file.getvalue()
    assert "success" in shown
    assert "out.parquet" in shown


def test_nothing_is_written_unasked(tmp_path, listener, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_evaluate(options(EvaluateConfig, **QUICK), listener)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "changes", [{}, {"profile": "hardware"}, {"controller": "policy", "profile": "hardware", "arena": "room-6"}]
)
def test_results_depend_neither_on_chunks_nor_on_threads(changes, monkeypatch):
    config = options(EvaluateConfig, **(QUICK | {"threads": 1} | changes))
    together = evaluate(config).runs
    monkeypatch.setattr(runs_module, "ROBOTS_PER_CHUNK", 4)
    assert [part.stop - part.start for part in chunks(3, 4)] == [1, 1, 1]
    config = options(EvaluateConfig, **(QUICK | {"threads": 3} | changes))
    apart = evaluate(config).runs
    for name, column in together.items():
        np.testing.assert_array_equal(apart[name], column, err_msg=name)


def test_a_run_is_a_function_of_size_seed_and_index():
    few = evaluate(options(EvaluateConfig, **QUICK)).runs
    more = evaluate(options(EvaluateConfig, **(QUICK | {"robots": (4,), "runs": 5}))).runs
    np.testing.assert_array_equal(more["formation_error"][:3], few["formation_error"][3:])


@pytest.mark.parametrize(("runs", "robots"), [(1, 1), (100, 5), (100, 13), (1, 10_000), (7, 300), (1000, 1)])
def test_chunks_cover_all_runs_and_are_alike(runs, robots):
    parts = chunks(runs, robots)
    assert [run for part in parts for run in range(runs)[part]] == list(range(runs))
    sizes = {part.stop - part.start for part in parts}
    assert min(sizes) >= 1
    assert max(sizes) - min(sizes) <= 1
    assert max(sizes) == 1 or max(sizes) * robots <= 1.5 * runs_module.ROBOTS_PER_CHUNK + robots


def test_progress_adds_up_and_sizes_come_in_the_order_of_the_configuration():
    class Watching:
        def __init__(self):
            self.total, self.done = 0.0, []

        @contextmanager
        def progress(self, description, total):
            self.total = total
            yield self.done.append

        say = milestone = table = staticmethod(lambda *given, **options: None)

    watching, seen = Watching(), []
    config = options(EvaluateConfig, **(QUICK | {"robots": (4, 1, 3), "threads": 2}))
    evaluate(config, watching, lambda found: seen.append([row["robots"] for row in found.results]))
    assert sum(watching.done) == watching.total == 3 * 8 * config.scenario.steps
    assert seen[-1] == [4, 1, 3]
    for sizes in seen:
        assert sizes == [robots for robots in (4, 1, 3) if robots in sizes]


def test_world_seeds_differ_between_runs_sizes_and_purposes():
    states = {
        tuple(seed.generate_state(2))
        for sequences in (world_seeds(3, 7, range(4)), world_seeds(4, 7, range(4)), world_seeds(3, 7, range(4), 9))
        for seed in sequences
    }
    assert len(states) == 12


def test_explicit_starts_decide_sizes_and_disconnected_ones_are_reported_apart(tmp_path):
    rows = [(0, i, x, 0.0, 0.0) for i, x in enumerate([0.0, 1.0])]
    rows += [(1, i, x, 0.0, 0.0) for i, x in enumerate([0.0, 1.0, 2.0])]
    rows += [(2, i, x, 0.0, 0.0) for i, x in enumerate([0.0, 3.0])]
    np.save(tmp_path / "starts.npy", np.array(rows))
    evaluation = evaluate(options(EvaluateConfig, **(QUICK | {"starts": tmp_path / "starts.npy"})))
    assert [(result["robots"], result["runs"], result["success"]) for result in evaluation.results] == [
        (2, 1, 1.0),
        (3, 1, 1.0),
    ]
    assert [(result["robots"], result["runs"]) for result in evaluation.disconnected_starts] == [(2, 1)]
    assert evaluation.runs["run"].tolist() == [0, 2, 1]


def test_noise_of_a_run_from_a_file_depends_on_its_index_in_the_file_alone(tmp_path, monkeypatch):
    """The same start, once as the only one of its size, once behind another of its size, has the same noise."""

    class Wavering:
        privileged = False
        description = {"name": "wavering"}  # noqa: RUF012

        def command(self, view):
            nearness = np.exp(-np.nan_to_num(view.scans.ranges, nan=9.0)).mean(axis=-1)
            return nearness[..., None] * [1.0, 0.0, 0.0]

    monkeypatch.setattr(scenario_module, "make_controller", lambda *args, **options: Wavering())
    pair, three = ([(i, x, 0.0, 0.0) for i, x in enumerate(places)] for places in ([0.0, 0.8], [0.0, 1.0, 2.0]))
    tables = []
    for name, order in (("a.npy", [three, pair]), ("b.npy", [pair, pair])):
        np.save(tmp_path / name, np.array([(run, *row) for run, team in enumerate(order) for row in team]))
        tables.append(
            evaluate(options(EvaluateConfig, **(QUICK | {"starts": tmp_path / name, "profile": "hardware"}))).runs
        )
    (alone,) = tables[0]["formation_error"][tables[0]["robots"] == 2]
    first, second = tables[1]["formation_error"]
    assert tables[0]["run"].tolist() == [1, 0]
    assert alone == second
    assert alone != first


def test_runs_of_a_file_are_counted_in_the_order_of_their_numbers(tmp_path):
    rows = [(run, i, float(x), 0.0, 0.0) for run, places in ((40, (0, 1)), (7, (0, 1.5))) for i, x in enumerate(places)]
    np.save(tmp_path / "starts.npy", np.array(rows))
    (cell,) = options(EvaluateConfig, **(QUICK | {"starts": tmp_path / "starts.npy"})).cells
    assert cell.starts.indices.tolist() == [0, 1]
    assert cell.starts.poses[:, 1, 0].tolist() == [1.5, 1.0]


@pytest.mark.parametrize("robots", [1, 2])
def test_the_smallest_teams_have_defined_results(robots, tmp_path, listener):
    path = tmp_path / "out.json"
    run_evaluate(options(EvaluateConfig, **(QUICK | {"robots": (robots,), "json": path})), listener)
    result = json.loads(path.read_text())["results"][0]
    assert result["runs"] == 3
    assert result["success"] == (0 if robots == 1 else 1)
    assert (result["formation_error_median"] is None) == (robots == 1)


def test_arena_hits_are_reported(tmp_path):
    scenario = Scenario(arena="room-6", duration=6.0, guard="none")
    _, table = scenario.run(np.array([[[2.8, 0.0, 0.0], [2.3, 0.0, 0.0]]]), "expert-sensed", seed=0)
    assert table["hit_arena"].all()


def test_starts_that_the_arena_blocks_are_refused_before_anything_runs(monkeypatch):
    config = options(EvaluateConfig, **(QUICK | {"robots": (3, 25), "runs": 4, "arena": "room-6"}))
    monkeypatch.setattr(Cell, "run", lambda *given, **options: pytest.fail("too late"))
    monkeypatch.setattr(runs_module, "ROBOTS_PER_CHUNK", 25)
    with pytest.raises(TriformError, match=r"^nothing to run: 4 of 4 starts of 25 robots touch [^\n]*'room-6'"):
        evaluate(config)


def test_finished_sizes_survive_an_interruption(tmp_path, listener, monkeypatch):
    class Interrupted:
        privileged = False
        description = {"name": "interrupted"}  # noqa: RUF012

        def command(self, view):
            if view.active.shape[1] == 4:
                raise KeyboardInterrupt
            return np.zeros((*view.active.shape, 3))

    monkeypatch.setattr(scenario_module, "make_controller", lambda *args, **options: Interrupted())
    # Without kept kernels all sizes are driven for a moment first.
    monkeypatch.setattr(scenario_module, "kernels_were_compiled", lambda: True)
    with pytest.raises(KeyboardInterrupt):
        run_evaluate(options(EvaluateConfig, json=tmp_path / "out.json", threads=1, **QUICK), listener)
    written = json.loads((tmp_path / "out.json").read_text())
    assert [result["robots"] for result in written["results"]] == [3]
    assert len(pd.read_parquet(tmp_path / "out.parquet")) == 3


def test_bad_output_is_refused_before_anything_runs(tmp_path, listener, monkeypatch):
    monkeypatch.setattr(scenario_module, "make_controller", lambda *args, **options: pytest.fail("too late"))
    with pytest.raises(TriformError, match="cannot write"):
        run_evaluate(options(EvaluateConfig, json=tmp_path, **QUICK), listener)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robots": ()}, "robots is empty"),
        ({"robots": (3, 0)}, "robots is 0"),
        ({"runs": 0}, "runs is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"distance": -1.0}, "distance is -1"),
        ({"duration": float("nan")}, "duration is nan"),
        ({"threads": 0}, "threads is 0"),
        ({"engine": "steam"}, "no engine 'steam'"),
        ({"ray_address": "auto"}, "the engine is local"),
    ],
)
def test_bad_settings_are_refused(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        options(EvaluateConfig, **(QUICK | changes))


@pytest.mark.parametrize("changes", [{"controller": "magic"}, {"profile": "magic"}, {"arena": "magic"}])
def test_unknown_names_are_refused(changes):
    with pytest.raises(ConfigurationError, match="magic"):
        evaluate(options(EvaluateConfig, **(QUICK | changes)))


def test_a_run_too_short_to_be_measured_is_refused():
    with pytest.raises(TriformError, match="at least that long"):
        evaluate(options(EvaluateConfig, **(QUICK | {"duration": 2.0})))


def test_scenario_run_starts_where_it_is_told():
    poses = sample_starts(3, 2, 1)
    trajectory, _ = Scenario(duration=5.0).run(poses, "expert", seed=1)
    np.testing.assert_allclose(trajectory.poses[:, 0], poses)


class Rammer:
    """Drives at the nearest neighbour."""

    privileged = True
    description = {"name": "rammer"}  # noqa: RUF012

    def command(self, view):
        positions = view.poses[..., :2]
        apart = positions[:, None] - positions[:, :, None]
        lengths = np.linalg.norm(apart, axis=-1)
        lengths[:, np.arange(lengths.shape[1]), np.arange(lengths.shape[1])] = np.inf
        nearest = lengths.argmin(axis=-1)
        way = np.take_along_axis(apart, nearest[..., None, None], axis=2)[:, :, 0]
        heading = view.poses[..., 2]
        cos, sin = np.cos(heading), np.sin(heading)
        x, y = way[..., 0], way[..., 1]
        return np.stack([cos * x + sin * y, cos * y - sin * x, np.zeros_like(x)], axis=-1)


def test_the_guard_belongs_to_the_scenario_whoever_steers():
    poses = sample_starts(7, 20, 7)
    for guard, overlaps in (("filter", 0.0), ("orca", 0.0), ("none", 1.0)):
        _, table = Scenario(guard=guard, duration=10.0).run(poses, Rammer())
        assert table["collision"].mean() == overlaps
