from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from triform.experiments import reproduce as module
from triform.experiments.comparison import Comparison
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.experiments.reproduce import ReproduceConfig, reproduce
from triform.types import TriformError

SIZES = (3, 4)
QUICK = {"what": "comparison", "runs": 2, "duration": 6.0, "seed": 3}


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(module, "SIZES", SIZES)


def test_every_controller_runs_the_same_starts(tmp_path, console):
    reproduce(ReproduceConfig(compare=("expert", "expert-odd"), output=tmp_path, **QUICK), console)
    written = json.loads((tmp_path / "comparison.json").read_text())
    frame = pd.read_parquet(tmp_path / "comparison.parquet")
    assert frame.groupby("controller").size().to_dict() == {"expert": 4, "expert-odd": 4}
    for entry in written["controllers"]:
        name = entry["name"]
        alone = evaluate(EvaluateConfig(controller=name, robots=SIZES, runs=2, duration=6.0, seed=3))
        assert entry["config"]["controller_description"]["name"] == name
        assert [result["robots"] for result in entry["results"]] == list(SIZES)
        np.testing.assert_array_equal(frame[frame.controller == name].formation_error, alone.runs["formation_error"])
    assert (written["skipped"], written["waiting"]) == ({}, [])


def test_the_table_has_a_row_per_controller_and_size(tmp_path, console):
    reproduce(ReproduceConfig(compare=("expert", "expert-sensed"), output=tmp_path, **QUICK), console)
    markdown = (tmp_path / "comparison.md").read_text()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in markdown.splitlines() if line[:1] == "|"]
    assert rows[0] == [
        "controller", "robots", "success", "sensed", "strict", "hold", "strict at", "drift", "median error",
        "95 % error", "time", "compact", "closest", "overlap",
    ]  # fmt: skip
    assert [row[:2] for row in rows[2:]] == [[name, str(n)] for name in ("expert", "expert-sensed") for n in SIZES]
    assert "triform reproduce comparison" in markdown
    page = (tmp_path / "index.md").read_text()
    assert all(f"| {' | '.join(row)} |" in page for row in rows)
    assert "expert-sensed, " in console.file.getvalue()


def test_weights_that_are_not_there_are_left_out_with_a_note(tmp_path, console):
    config = ReproduceConfig(compare=("policy:nowhere", "expert"), output=tmp_path, **QUICK)
    reproduce(config, console)
    assert "leaves out policy:nowhere: there is no policy 'nowhere'" in console.file.getvalue()
    assert "Left out: policy:nowhere (there is no policy 'nowhere'" in (tmp_path / "comparison.md").read_text()
    written = json.loads((tmp_path / "comparison.json").read_text())
    assert [entry["name"] for entry in written["controllers"]] == ["expert"]
    assert set(written["skipped"]) == {"policy:nowhere"}


def test_nothing_left_to_compare_is_refused(tmp_path, console):
    config = ReproduceConfig(compare=("policy:nowhere",), output=tmp_path, **QUICK)
    with pytest.raises(TriformError, match="nothing to compare: there is no policy 'nowhere'"):
        reproduce(config, console)


def test_damaged_weights_are_refused_before_anything_runs(tmp_path, console, monkeypatch):
    monkeypatch.setattr(module, "evaluate", lambda *given, **options: pytest.fail("too late"))
    config = ReproduceConfig(compare=("expert", f"policy:{tmp_path}"), output=tmp_path / "out", **QUICK)
    with pytest.raises(TriformError, match="holds no policy"):
        reproduce(config, console)


def test_finished_controllers_survive_an_interruption(tmp_path, console, monkeypatch):
    def interrupted(config, on_progress=None, engine=None):
        if config.controller == "scan-pipeline":
            raise KeyboardInterrupt
        return evaluate(config, on_progress, engine=engine)

    monkeypatch.setattr(module, "evaluate", interrupted)
    config = ReproduceConfig(compare=("expert", "scan-pipeline", "expert-odd"), output=tmp_path, **QUICK)
    with pytest.raises(KeyboardInterrupt):
        reproduce(config, console)
    page = (tmp_path / "index.md").read_text()
    assert "Not finished: scan-pipeline, expert-odd." in page
    assert "| expert | 4 |" in page
    assert set(pd.read_parquet(tmp_path / "comparison.parquet").controller) == {"expert"}
    assert json.loads((tmp_path / "comparison.json").read_text())["waiting"] == ["scan-pipeline", "expert-odd"]


def test_a_plain_policy_has_the_weights_of_the_command_line():
    config = ReproduceConfig(compare=("policy", "policy:large", "expert"), weights="mine")
    assert [contestant.label for contestant in config.contestants] == ["policy:mine", "policy:large", "expert"]
    assert ReproduceConfig(compare=("policy",)).contestants[0].label == "policy:default"


def test_all_controllers_are_compared_by_default():
    assert ReproduceConfig().compare == (
        "policy:default", "policy:paper", "expert", "expert-sensed", "triangulating", "scan-pipeline",
        "scan-triangulating",
    )  # fmt: skip
    assert len(Comparison.begin(ReproduceConfig(compare=("expert", "scan-pipeline"))).waiting) == 2
