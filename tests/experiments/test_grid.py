from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from triform.engines import LocalEngine
from triform.evaluation import Scenario, scenario
from triform.evaluation.metrics import summarise, wilson_interval
from triform.experiments import grid as measured
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.experiments.grid import Grid, RunCell, describe_runs, digest, measure_waiting, spread_out
from triform.types import ConfigurationError, TriformError

SEED = 3
ODD = Scenario(controller="expert-odd", duration=6.0)
CELLS = [
    RunCell("odd", ODD, 3, 2),
    RunCell("odd", replace(ODD, profile="hardware"), 3, 2),
    RunCell("all", Scenario(controller="expert", duration=6.0), 4, 3),
]


def finish(path, cells=CELLS, seed=SEED):
    found = Grid(path, cells, seed)
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
        config = EvaluateConfig(
            controller="expert-odd", profile=profile, robots=(3,), runs=2, seed=SEED, duration=6.0, threads=1
        )
        for name, column in evaluate(config).runs.items():
            np.testing.assert_array_equal(found.table(cell)[name], column, err_msg=name)


def test_every_cell_has_its_rows_and_its_summary(done):
    path, found = done
    frame = pd.read_parquet(path)
    assert found.labels == ["odd", "all"]
    keys = frame[["label", "profile", "team"]].drop_duplicates().itertuples(index=False, name=None)
    assert list(keys) == [cell.key for cell in CELLS]
    for cell, summary in zip(CELLS, found.summaries(), strict=True):
        own = frame[(frame.label == cell.label) & (frame.profile == cell.scenario.profile)]
        assert own.run.tolist() == list(range(cell.runs))
        table = {name: own[name].to_numpy() for name in found.table(cell)}
        expected = summarise(table)
        assert {name: summary[name] for name in expected} == pytest.approx(expected, nan_ok=True)
        assert summary["strict_interval"] == wilson_interval(int(own.strict.sum()), cell.runs)
        assert summary["collisions"] == own.collision.sum()
        assert summary["settings"]["seed"] == SEED
        assert summary["settings"]["controller_description"]["name"] == cell.scenario.controller


def test_results_depend_neither_on_chunks_nor_on_threads(done, monkeypatch, tmp_path):
    monkeypatch.setattr(scenario, "ROBOTS_PER_CHUNK", 3)
    found = Grid(tmp_path / "cells.parquet", CELLS, SEED)
    for _ in found.measure(LocalEngine(2)):
        pass
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "cells.parquet"), pd.read_parquet(done[0]))


def test_what_is_done_is_not_run_again(done, tmp_path, monkeypatch):
    path = tmp_path / "cells.parquet"
    path.write_bytes(done[0].read_bytes())
    monkeypatch.setattr(measured, "MeasureRuns", lambda *given: pytest.fail("nothing should be run"))
    found = finish(path)
    assert found.waiting == []
    np.testing.assert_equal(found.summaries(), done[1].summaries())


def test_other_cells_are_kept_and_other_settings_replace(done, tmp_path):
    path = tmp_path / "cells.parquet"
    path.write_bytes(done[0].read_bytes())
    more = RunCell("all", replace(CELLS[2].scenario, duration=5.0), 3, 1)
    changed = replace(CELLS[2], runs=1)
    found = finish(path, [more, changed])
    assert [summary["runs"] for summary in found.summaries()] == [1, 1]
    frame = pd.read_parquet(path)
    assert len(frame) == 2 + 2 + 1 + 1
    # The cells that were there before are still done, but for the one that other settings replaced.
    assert Grid(path, CELLS, SEED).waiting == [CELLS[2]]
    assert Grid(path, CELLS, SEED + 1).waiting == CELLS


def test_equal_settings_are_run_once(tmp_path):
    twin = replace(CELLS[0], label="twin")
    found = Grid(tmp_path / "cells.parquet", [CELLS[0], CELLS[2], twin], SEED)
    assert found.waiting == [CELLS[0], CELLS[2]]
    finish(tmp_path / "cells.parquet", [CELLS[0], twin])
    assert Grid(tmp_path / "cells.parquet", [twin], SEED).waiting == []


def test_finished_cells_survive_an_interruption(tmp_path, console):
    def interrupt(seconds):
        raise KeyboardInterrupt

    path = tmp_path / "cells.parquet"
    with pytest.raises(KeyboardInterrupt):
        measure_waiting(Grid(path, CELLS, SEED), LocalEngine(1), console, interrupt)
    found = Grid(path, CELLS, SEED)
    assert found.waiting == CELLS[1:]
    told = []
    measure_waiting(found, LocalEngine(1), console, told.append)
    assert len(told) == 3
    assert told == sorted(told)
    assert "odd, 3 robots, hardware" in console.file.getvalue()


def test_the_work_can_be_sent_to_another_machine(done):
    _, found = done
    portable = found._portables[CELLS[0].scenario]
    far = pickle.loads(pickle.dumps(portable)).controller
    assert far.description == found.controller(CELLS[0]).description


def test_controllers_that_cannot_be_made_are_left_out(tmp_path, console):
    missing = RunCell("mine", Scenario(weights="nowhere", duration=6.0), 3, 1)
    found = Grid(tmp_path / "cells.parquet", [missing, CELLS[0], replace(missing, robots=4)], SEED)
    assert found.cells == [CELLS[0]]
    assert list(found.skipped) == ["mine"]
    measure_waiting(found, LocalEngine(1), console, lambda seconds: None)
    assert "left out: mine: there is no policy 'nowhere'" in console.file.getvalue()
    with pytest.raises(TriformError, match="nothing to run: there is no policy 'nowhere'"):
        Grid(tmp_path / "cells.parquet", [missing], SEED)


def test_what_a_run_would_stumble_over_is_refused_first(tmp_path):
    path = tmp_path / "cells.parquet"
    for cell, message in (
        (RunCell("odd", replace(ODD, duration=6.05), 3, 1), "whole number of control periods"),
        (RunCell("odd", replace(ODD, arena="room-6"), 25, 1), "1 of 1 starts of 25 robots"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            Grid(path, [cell], SEED)
    path.write_text("no table")
    with pytest.raises(TriformError, match="cannot be read"):
        Grid(path, CELLS, SEED)
    pd.DataFrame({"run": [1]}).to_parquet(path)
    with pytest.raises(TriformError, match="not written by this command"):
        Grid(path, CELLS, SEED)


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
        Scenario(team="gazebo"),
        Scenario(team="gazebo", drive="mecanum"),
        Scenario(profile="hardware"),
    ]
    described = [describe_runs(each, each.make_controller(), 5, 10, 7) for each in scenarios]
    assert len({digest(each) for each in described}) == len(scenarios)
