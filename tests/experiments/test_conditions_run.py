from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from tests.options import options
from triform.commands.terminal import Terminal
from triform.evaluation import runs as runs_module
from triform.evaluation.statistics import wilson_interval
from triform.experiments import grid as grid_module
from triform.experiments.cell import Cell
from triform.experiments.conditions import ConditionsConfig, failed_runs, run_conditions
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.experiments.grid import Grid, read_labels
from triform.types import TriformError

QUICK = {
    "controller": "expert-odd", "robots": (3, 4), "runs": 3, "seed": 3, "duration": 12.0, "event_time": 6.0,
    "which": ("latency", "event"), "failures": 3,
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished sweep, not to be written to."""
    from io import StringIO

    from rich.console import Console

    output = tmp_path_factory.mktemp("sweep")
    run_conditions(
        options(ConditionsConfig, output=output, threads=1, **QUICK), Terminal(Console(file=StringIO(), width=80))
    )
    return output


def rows(folder):
    return pd.read_parquet(folder / "conditions.parquet")


def summaries(folder):
    return json.loads((folder / "conditions.json").read_text())["cells"]


def test_all_files_are_written(folder):
    names = {path.name for path in folder.iterdir()}
    assert names == {
        "conditions.json", "conditions.parquet", "conditions.md", "conditions.html", "conditions.png",
        "conditions.pdf", "failures.png", "failures.pdf",
    }  # fmt: skip
    page = (folder / "conditions.md").read_text()
    for heading in ("## All conditions", "## Latency", "## Event", "## Failed runs"):
        assert heading in page
    assert "## Speed" not in page
    assert "This controller sees true poses" in page
    assert "| latency [s] | robots |" in page
    assert "triform conditions --controller expert-odd" in page
    assert len([line for line in page.splitlines() if line.startswith("| 0.05 |")]) == 2


def test_every_cell_is_summarised_from_its_rows(folder):
    frame = rows(folder)
    cells = summaries(folder)
    assert len(cells) == 6 * 2 + 4 * 2 + 1
    assert len(frame) == 3 * len(cells)
    for cell in cells:
        own = frame[(frame.condition == cell["condition"]) & (frame.label == cell["label"])]
        own = own[own.team == cell["robots"]]
        assert own.run.tolist() == [0, 1, 2]
        assert cell["strict"] == own.strict.mean()
        assert cell["strict_interval"] == pytest.approx(wilson_interval(int(own.strict.sum()), 3))
        assert cell["success_interval"] == pytest.approx(wilson_interval(int(own.success.sum()), 3))
        assert (cell["collisions"], cell["arena_hits"]) == (own.collision.sum(), own.hit_arena.sum())
    latencies = [cell["settings"]["profile_description"]["latency"] for cell in cells if cell["condition"] == "latency"]
    assert latencies == [0, 0, 0.05, 0.05, 0.1, 0.1, 0.2, 0.2, 0.3, 0.3, 0.5, 0.5]


def test_values_are_compared_with_the_first_where_starts_are_the_same(folder):
    found = json.loads((folder / "conditions.json").read_text())["paired"]
    latencies = [(label, robots, "0") for label in ("0.05", "0.1", "0.2", "0.3", "0.5") for robots in (3, 4)]
    # Teams that meet start elsewhere.
    events = [(label, robots, "join") for label in ("leave", "push", "stuck") for robots in (3, 4)]
    assert [(row["label"], row["robots"], row["reference"]) for row in found] == latencies + events
    assert {row["strict"]["pairs"] for row in found} == {3}
    page = (folder / "conditions.md").read_text()
    assert "p: 10 comparisons with the first row with as many robots (ref)." in page
    headings = next(line for line in page.splitlines() if line.startswith("| latency [s]"))
    assert "| strict | p strict | success | p success |" in headings


def test_runs_are_those_of_an_evaluation(folder):
    alone = evaluate(
        options(EvaluateConfig, controller="expert-odd", robots=(3,), runs=3, seed=3, duration=12.0, latency=0.1)
    )
    frame = rows(folder)
    own = frame[(frame.condition == "latency") & (frame.label == "0.1") & (frame.team == 3)]
    for name, column in alone.runs.items():
        np.testing.assert_array_equal(own[name], column, err_msg=name)


@pytest.mark.parametrize("changes", [{}, {"controller": "scan-pipeline", "range_noise": 0.01, "robots": (3,)}])
def test_results_depend_neither_on_chunks_nor_on_threads(changes, monkeypatch, tmp_path, listener):
    small = {"which": ("event",), "failures": 0} | changes
    run_conditions(options(ConditionsConfig, output=tmp_path / "one", **(QUICK | small | {"threads": 1})), listener)
    monkeypatch.setattr(runs_module, "ROBOTS_PER_CHUNK", 4)
    run_conditions(options(ConditionsConfig, output=tmp_path / "two", **(QUICK | small | {"threads": 2})), listener)
    pd.testing.assert_frame_equal(rows(tmp_path / "one"), rows(tmp_path / "two"))


def open_grid(config):
    path = config.output / "conditions.parquet"
    return Grid(config.list_cells({*config.which, *read_labels(path, "condition")}), path)


def test_what_is_done_is_not_run_again(folder, tmp_path, listener, monkeypatch):
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(grid_module, "_MeasureChunks", lambda *given: pytest.fail("nothing should be run"))
    config = options(ConditionsConfig, output=tmp_path, **QUICK)
    assert not open_grid(config).waiting
    monkeypatch.undo()
    run_conditions(config, listener)
    pd.testing.assert_frame_equal(rows(tmp_path), rows(folder))
    assert summaries(tmp_path) == summaries(folder)


def test_other_conditions_are_added_and_other_settings_replace(folder, tmp_path):
    (tmp_path / "conditions.parquet").write_bytes((folder / "conditions.parquet").read_bytes())
    more = open_grid(options(ConditionsConfig, output=tmp_path, **(QUICK | {"which": ("speed",)})))
    assert {cell.labels["condition"] for cell in more.done} == {"latency", "event", "speed"}
    # The speed of the profile has been run already, under another condition.
    assert {cell.labels["label"] for cell in more.done if cell.labels["condition"] == "speed"} == {"0.5"}
    assert {cell.labels["label"] for cell in more.waiting} == {"0.05", "0.1", "0.2", "1"}
    other = open_grid(options(ConditionsConfig, output=tmp_path, **(QUICK | {"seed": 4})))
    assert not other.done
    later = open_grid(options(ConditionsConfig, output=tmp_path, **(QUICK | {"event_time": 7.0})))
    # A robot that is stuck and teams that meet do not depend on the moment of the other events.
    assert {cell.labels["condition"] for cell in later.done} == {"latency"}


def test_equal_cells_are_run_once():
    which = ("range-noise", "dropped-rays", "scan-rate", "latency", "speed", "footprint", "arena", "distance")
    config = options(ConditionsConfig, **(QUICK | {"which": which}))
    waiting = Grid(config.list_cells(set(which))).waiting
    assert len(waiting) == 2 * (1 + 5 + 4 + 4 + 5 + 4 + 6 + 3 + 4)
    assert [cell.labels["label"] for cell in waiting][:3] == ["0", "0", "0.5"]


def test_finished_cells_survive_an_interruption(tmp_path, listener, monkeypatch):
    run = Cell.run

    def interrupted(cell, *given):
        if cell.labels["label"] == "0.2":
            raise KeyboardInterrupt
        return run(cell, *given)

    monkeypatch.setattr(Cell, "run", interrupted)
    config = options(ConditionsConfig, output=tmp_path, threads=1, **(QUICK | {"which": ("latency",), "robots": (3,)}))
    with pytest.raises(KeyboardInterrupt):
        run_conditions(config, listener)
    assert [cell["label"] for cell in summaries(tmp_path)] == ["0", "0.05", "0.1"]
    monkeypatch.undo()
    assert [cell.labels["label"] for cell in open_grid(config).waiting] == ["0.2", "0.3", "0.5"]


def test_what_cannot_be_run_is_left_out_with_its_reason(tmp_path, listener):
    config = options(
        ConditionsConfig,
        output=tmp_path,
        **(QUICK | {"which": ("arena", "scan-rate"), "robots": (25,), "runs": 1, "duration": 12.2}),
    )
    run_conditions(config, listener)
    written = json.loads((tmp_path / "conditions.json").read_text())
    assert list(written["skipped"]) == [
        "scan rate 2 Hz, 25 robots", "arena room-6, 25 robots", "arena pillars, 25 robots",
        "arena living-room, 25 robots",
    ]  # fmt: skip
    assert [(cell["condition"], cell["label"]) for cell in written["cells"]] == [
        ("scan-rate", "5"), ("scan-rate", "10"), ("scan-rate", "20"), ("scan-rate", "50"), ("arena", "open"),
    ]  # fmt: skip
    assert "whole number of control periods" in written["skipped"]["scan rate 2 Hz, 25 robots"]
    assert "left out: arena room-6, 25 robots: 1 of 1 starts" in listener.console.file.getvalue()
    assert "Left out: scan rate 2 Hz" in (tmp_path / "conditions.md").read_text()


def test_nothing_to_run_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(TriformError, match="there is no controller 'magic'"):
        open_grid(options(ConditionsConfig, output=tmp_path, controller="magic"))
    (tmp_path / "conditions.parquet").write_text("no table")
    with pytest.raises(TriformError, match="cannot be read"):
        open_grid(options(ConditionsConfig, output=tmp_path, **QUICK))
    pd.DataFrame({"a": [1]}).to_parquet(tmp_path / "conditions.parquet")
    with pytest.raises(TriformError, match="not written by this command"):
        open_grid(options(ConditionsConfig, output=tmp_path, **QUICK))


def test_failed_runs_are_drawn_as_they_were_measured(folder):
    found = open_grid(options(ConditionsConfig, output=folder, **QUICK))
    failures = failed_runs(found, 3)
    assert len(failures) == 3
    # Conditions take turns.
    assert [failure.title.split()[0] for failure in failures[:2]] == ["latency", "event"]
    for failure in failures:
        cell = next(cell for cell in found.cells if failure.title.startswith(cell.name))
        run = int(failure.title.split()[-1])
        _, table = cell.run(run, 1, found.controller(cell))
        measured = found.table(cell)
        assert not measured["strict"][run]
        for name in measured:
            np.testing.assert_array_equal(table[name], measured[name][run : run + 1], err_msg=name)
        assert failure.trajectory.poses.shape[0] == 1


def test_a_page_says_what_the_controller_sees_whatever_guards_it(tmp_path, listener):
    for controller, sees_poses in (("scan-pipeline", False), ("expert", True)):
        changes = {"controller": controller, "which": ("guard",), "robots": (3,), "runs": 1, "failures": 0}
        output = tmp_path / controller
        run_conditions(options(ConditionsConfig, output=output, guard="orca", **(QUICK | changes)), listener)
        page = (output / "conditions.md").read_text()
        assert "Robots drive behind ORCA." in page
        assert ("This controller sees true poses" in page) == sees_poses
        assert [cell["label"] for cell in summaries(output)] == ["filter", "orca", "none"]
