from __future__ import annotations

import json
import re

import numpy as np
import pandas as pd
import pytest

from tests.options import options
from triform.cli import main
from triform.commands.terminal import Terminal
from triform.control import CONTROLLERS, TriangulatingLaw
from triform.experiments.compare import CompareConfig, run_compare
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.experiments.grid import Grid
from triform.types import ConfigurationError, TriformError

QUICK = {
    "controllers": ("expert", "policy:nowhere", "triangulating"), "robots": (3, 14), "hardware_robots": (3,), "runs": 2,
    "large_runs": 1, "seed": 3, "duration": 5.0, "threads": 1,
}  # fmt: skip


def compared(output, **changes):
    from io import StringIO

    from rich.console import Console

    console = Console(file=StringIO(), width=100)
    run_compare(options(CompareConfig, output=output, **(QUICK | changes)), Terminal(console))
    return console.file.getvalue()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished comparison, not to be written to."""
    output = tmp_path_factory.mktemp("compare")
    compared(output)
    return output


def table_rows(text):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]


def test_all_files_of_a_comparison_are_written(folder):
    names = {path.name for path in folder.iterdir()}
    assert names == {"compare.json", "compare.parquet", "compare.md", "compare.html"}
    page = (folder / "compare.md").read_text()
    rows = table_rows(page)
    assert rows[0] == ["controller", "sees", "parameters", "step [ms]", "3", "14", "3*", "p"]
    assert [row[:3] for row in rows[2:4]] == [
        ["expert", "everybody's pose", "-"],
        ["triangulating", f"poses within {TriangulatingLaw().sight:g} d* in line of sight", "-"],
    ]
    assert all(float(row[3]) > 0 for row in rows[2:4])
    assert [row[-1] for row in rows[2:4]] == ["ref", "1.00"]
    assert re.fullmatch(r"\d+ % \(\d+-\d+\)", rows[2][4])
    assert "p: 1 comparison with expert, all columns together (ref). p is the chance" in page
    for heading in ("## Strict runs", "## Success", "## Median error", "## Strict at"):
        assert heading in page
    assert len(rows) == 4 * 4
    assert "Left out: policy:nowhere (there is no policy 'nowhere'" in page
    assert "`triform compare --controllers expert policy:nowhere triangulating" in page


def test_every_controller_of_a_comparison_runs_the_same_starts(folder):
    frame = pd.read_parquet(folder / "compare.parquet")
    written = json.loads((folder / "compare.json").read_text())
    assert frame.groupby("label").size().to_dict() == {"expert": 5, "triangulating": 5}
    for label in ("expert", "triangulating"):
        for profile, robots, runs, duration in (("ideal", 3, 2, 5.0), ("ideal", 14, 1, 15.0), ("hardware", 3, 2, 5.0)):
            config = options(
                EvaluateConfig,
                controller=label,
                profile=profile,
                robots=(robots,),
                runs=runs,
                seed=3,
                duration=duration,
                threads=1,
            )
            own = frame[(frame.label == label) & (frame.profile == profile) & (frame.team == robots)]
            for name, column in evaluate(config).runs.items():
                np.testing.assert_array_equal(own[name], column, err_msg=name)
    assert [(cell["label"], cell["profile"], cell["robots"]) for cell in written["cells"]] == [
        (label, *column)
        for label in ("expert", "triangulating")
        for column in (("ideal", 3), ("ideal", 14), ("hardware", 3))
    ]
    assert [each["label"] for each in written["controllers"]] == ["expert", "triangulating"]
    assert list(written["skipped"]) == ["policy:nowhere"]
    (paired,) = written["paired"]
    assert (paired["label"], paired["reference"], paired["strict"]["pairs"]) == ("triangulating", "expert", 5)
    by_label = {label: own.reset_index() for label, own in frame.groupby("label")}
    gains = by_label["triangulating"].formation_error - by_label["expert"].formation_error
    assert paired["formation_error"]["higher"] == (gains > 1e-6).sum()


def test_a_comparison_goes_on_with_more_controllers(folder, tmp_path):
    (tmp_path / "compare.parquet").write_bytes((folder / "compare.parquet").read_bytes())
    told = compared(tmp_path, controllers=("expert-odd",), robots=(3,), hardware_robots=())
    assert [line.split(": ")[1] for line in told.splitlines() if line.startswith("done")] == [
        "expert-odd, 3 robots, ideal"
    ]
    assert table_rows((tmp_path / "compare.md").read_text())[0][4:] == ["3", "p"]
    told = compared(tmp_path, controllers=("triangulating", "expert-odd", "expert"), hardware_robots=())
    assert [line.split(": ")[1] for line in told.splitlines() if line.startswith("done")] == [
        "expert-odd, 14 robots, ideal"
    ]
    before, after = (pd.read_parquet(path / "compare.parquet") for path in (folder, tmp_path))
    pd.testing.assert_frame_equal(after[: len(before)], before)
    rows = table_rows((tmp_path / "compare.md").read_text())
    assert [row[0] for row in rows[2:5]] == ["triangulating", "expert-odd", "expert"]


def test_learned_controllers_have_their_weights():
    config = options(CompareConfig, controllers=("policy", "policy:large", "gnn", "expert"))
    labels = [contestant.label for contestant in config.compared]
    assert labels == ["policy:default", "policy:large", "gnn:gnn", "expert"]
    assert {cell.controller.weights for cell in config.cells if cell.labels["label"] == "policy:large"} == {"large"}


def test_all_controllers_are_compared_unless_some_are_named():
    config = CompareConfig()
    assert {contestant.name for contestant in config.compared} == set(CONTROLLERS)
    cells = [cell for cell in config.cells if cell.labels["label"] == "expert"]
    assert [(cell.scenario.profile, cell.robots, cell.runs, cell.scenario.duration) for cell in cells] == [
        ("ideal", 5, 100, 40.0), ("ideal", 7, 100, 40.0), ("ideal", 9, 100, 40.0), ("ideal", 11, 100, 40.0),
        ("ideal", 13, 100, 40.0), ("ideal", 25, 20, 120.0), ("ideal", 50, 20, 120.0), ("ideal", 100, 20, 120.0),
        ("hardware", 4, 100, 40.0), ("hardware", 5, 100, 40.0), ("hardware", 7, 100, 40.0),
        ("hardware", 9, 100, 40.0),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"controllers": ()}, "controllers is empty"),
        ({"controllers": ("magic",)}, "no controller 'magic'"),
        ({"controllers": ("policy", "policy:default")}, "names policy:default 2 times"),
        ({"robots": (), "hardware_robots": ()}, "at least one team size"),
        ({"robots": (5, 0)}, "robots is 0"),
        ({"hardware_robots": (0,)}, "robots is 0"),
        ({"runs": 0}, "runs is 0"),
        ({"large_runs": 0}, "large_runs is 0"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_bad_settings_of_a_comparison_are_refused(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        options(CompareConfig, **changes)


def test_a_comparison_of_nothing_is_refused(tmp_path, listener):
    with pytest.raises(TriformError, match="nothing to run: there is no policy 'nowhere'"):
        run_compare(options(CompareConfig, output=tmp_path, controllers=("policy:nowhere",)), listener)


def test_damaged_weights_are_refused_before_a_comparison(tmp_path, listener):
    config = options(CompareConfig, output=tmp_path / "out", controllers=("expert", f"policy:{tmp_path}"))
    with pytest.raises(TriformError, match="holds no policy"):
        run_compare(config, listener)


def test_the_command_line_has_no_options_that_a_comparison_chooses(capsys):
    with pytest.raises(SystemExit):
        main(["compare", "--controller", "expert"])
    assert "--controller" in capsys.readouterr().err


def test_every_default_controller_is_shipped(tmp_path):
    cells = options(CompareConfig, robots=(3,), hardware_robots=(), runs=1, duration=5.0).cells
    assert Grid(cells).skipped == {}
