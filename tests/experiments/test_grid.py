from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from tests.options import options
from triform.control import ControllerSpec
from triform.engines import LocalEngine
from triform.evaluation import Scenario
from triform.evaluation import runs as runs_module
from triform.evaluation.metrics import summarise
from triform.evaluation.runs import Execution
from triform.evaluation.statistics import wilson_interval
from triform.experiments import grid as measured
from triform.experiments.cell import Cell
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.experiments.grid import Grid, measure_grid, spread_out
from triform.experiments.settings import digest
from triform.types import TriformError

SEED = 3
SIX = Scenario(duration=6.0)


def make_cell(label, controller, scenario, robots, runs, seed=SEED):
    labels = {"label": label, "profile": scenario.profile}
    name, who = f"{label}, {robots} robots, {scenario.profile}", ControllerSpec.parse(controller)
    return Cell(labels, scenario, who, robots, runs, seed, name, label)


CELLS = [
    make_cell("odd", "expert-odd", SIX, 3, 2),
    make_cell("odd", "expert-odd", replace(SIX, profile="hardware"), 3, 2),
    make_cell("all", "expert", SIX, 4, 3),
]
ONE = Execution(threads=1)


def finish(path, cells=CELLS):
    found = Grid(cells, path)
    for _ in found.measure(LocalEngine(1)):
        pass
    return found


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A finished table, not to be written to."""
    path = tmp_path_factory.mktemp("measured") / "cells.parquet"
    return path, finish(path)


def test_runs_are_those_of_an_evaluation(done):
    _, found = done
    for cell, profile in zip(CELLS[:2], ("ideal", "hardware"), strict=True):
        config = options(
            EvaluateConfig, controller="expert-odd", profile=profile, robots=(3,), runs=2, seed=SEED, duration=6.0,
            threads=1,
        )  # fmt: skip
        for name, column in evaluate(config).runs.items():
            np.testing.assert_array_equal(found.table(cell)[name], column, err_msg=name)


def test_every_cell_has_its_rows_and_its_summary(done):
    path, found = done
    frame = pd.read_parquet(path)
    keys = frame[["label", "profile", "team"]].drop_duplicates().itertuples(index=False, name=None)
    assert list(keys) == [cell.key for cell in CELLS]
    for cell, summary in zip(CELLS, found.summaries(), strict=True):
        own = frame[(frame.label == cell.labels["label"]) & (frame.profile == cell.scenario.profile)]
        assert own.run.tolist() == list(range(cell.runs))
        table = {name: own[name].to_numpy() for name in found.table(cell)}
        expected = summarise(table)
        np.testing.assert_equal({name: summary[name] for name in expected}, expected)
        assert summary["strict_interval"] == wilson_interval(int(own.strict.sum()), cell.runs)
        assert summary["collisions"] == own.collision.sum()
        assert summary["settings"]["seed"] == SEED
        assert summary["settings"]["controller_description"]["name"] == cell.controller.name


def test_results_depend_neither_on_chunks_nor_on_threads(done, monkeypatch, tmp_path):
    monkeypatch.setattr(runs_module, "ROBOTS_PER_CHUNK", 3)
    found = Grid(CELLS, tmp_path / "cells.parquet")
    for _ in found.measure(LocalEngine(2)):
        pass
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "cells.parquet"), pd.read_parquet(done[0]))


def test_what_is_done_is_not_run_again(done, tmp_path, monkeypatch):
    path = tmp_path / "cells.parquet"
    path.write_bytes(done[0].read_bytes())
    monkeypatch.setattr(measured, "_MeasureChunks", lambda *given: pytest.fail("nothing should be run"))
    found = Grid(CELLS, path)
    assert found.waiting == []
    np.testing.assert_equal(found.summaries(), done[1].summaries())


def test_other_cells_are_kept_and_other_settings_replace(done, tmp_path):
    path = tmp_path / "cells.parquet"
    path.write_bytes(done[0].read_bytes())
    more = make_cell("all", "expert", replace(SIX, duration=5.0), 3, 1)
    changed = replace(CELLS[2], runs=1)
    found = finish(path, [more, changed])
    assert [summary["runs"] for summary in found.summaries()] == [1, 1]
    frame = pd.read_parquet(path)
    assert len(frame) == 2 + 2 + 1 + 1
    # The cells that were there before are still done, but for the one that other settings replaced.
    assert Grid(CELLS, path).waiting == [CELLS[2]]
    other = [replace(cell, seed=SEED + 1) for cell in CELLS]
    assert Grid(other, path).waiting == other


def test_equal_settings_are_run_once(tmp_path):
    twin = replace(CELLS[0], labels={"label": "twin", "profile": "ideal"})
    found = Grid([CELLS[0], CELLS[2], twin], tmp_path / "cells.parquet")
    assert found.waiting == [CELLS[0], CELLS[2]]
    finish(tmp_path / "cells.parquet", [CELLS[0], twin])
    assert Grid([twin], tmp_path / "cells.parquet").waiting == []


def test_finished_cells_survive_an_interruption(tmp_path, listener):
    def interrupt(seconds):
        raise KeyboardInterrupt

    path = tmp_path / "cells.parquet"
    with pytest.raises(KeyboardInterrupt):
        measure_grid(Grid(CELLS, path), ONE, interrupt, listener)
    found = Grid(CELLS, path)
    assert found.waiting == CELLS[1:]
    told = []
    measure_grid(found, ONE, told.append, listener)
    assert len(told) == 3
    assert told == sorted(told)
    assert "odd, 3 robots, hardware" in listener.console.file.getvalue()


def test_the_work_can_be_sent_to_another_machine(done):
    _, found = done
    task = measured._MeasureChunks({0: CELLS[0]}, {0: found.controller(CELLS[0])})
    far = pickle.loads(pickle.dumps(task))
    table, _ = far(measured._Chunk(0, 1, 1), lambda work: None)
    for name, column in table.items():
        np.testing.assert_array_equal(column, found.table(CELLS[0])[name][1:], err_msg=name)


def test_controllers_that_cannot_be_made_are_left_out(tmp_path, listener):
    missing = make_cell("mine", "policy:nowhere", SIX, 3, 1)
    found = Grid([missing, CELLS[0], replace(missing, robots=4)], tmp_path / "cells.parquet")
    assert found.cells == [CELLS[0]]
    assert list(found.skipped) == ["mine"]
    measure_grid(found, ONE, lambda seconds: None, listener)
    assert "left out: mine: there is no policy 'nowhere'" in listener.console.file.getvalue()
    with pytest.raises(TriformError, match="nothing to run: there is no policy 'nowhere'"):
        Grid([missing], tmp_path / "cells.parquet")


def test_what_a_run_would_stumble_over_is_refused_first(tmp_path):
    path = tmp_path / "cells.parquet"
    for cell, message in (
        (make_cell("odd", "expert-odd", replace(SIX, duration=6.05), 3, 1), "whole number of control periods"),
        (make_cell("odd", "expert-odd", replace(SIX, arena="room-6"), 25, 1), "1 of 1 starts of 25 robots"),
    ):
        with pytest.raises(TriformError, match=message):
            Grid([cell], path)
    path.write_text("no table")
    with pytest.raises(TriformError, match="cannot be read"):
        Grid(CELLS, path)
    pd.DataFrame({"run": [1]}).to_parquet(path)
    with pytest.raises(TriformError, match="not written by this command"):
        Grid(CELLS, path)


def test_measures_are_spread_out_over_columns():
    summaries = [
        {"label": "a", "profile": "ideal", "robots": 5, "strict": 0.5},
        {"label": "a", "profile": "hardware", "robots": 5, "strict": np.nan},
        {"label": "b", "profile": "ideal", "robots": 7, "strict": 1.0},
    ]
    columns = [("ideal", 5), ("ideal", 7), ("hardware", 5)]
    assert spread_out(summaries, "a", columns, "strict", "%") == ["50 %", "-", "-"]
    assert spread_out(summaries, "b", columns, "strict", "%") == ["-", "100 %", "-"]


def test_runs_of_another_body_are_other_runs():
    scenarios = [
        Scenario(),
        Scenario(simulator="gazebo"),
        Scenario(simulator="gazebo", base="mecanum"),
        Scenario(simulator="mujoco"),
        Scenario(profile="hardware"),
    ]
    described = [make_cell("a", "policy", each, 5, 10).settings(each.make_controller()) for each in scenarios]
    assert len({digest(each) for each in described}) == len(scenarios)
