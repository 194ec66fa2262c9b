from __future__ import annotations

import base64
import dataclasses
import importlib.util
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tyro
from PIL import Image

from tests.options import options
from triform.cli import COMMANDS
from triform.commands.options import CONFIG, registry
from triform.evaluation import Scenario
from triform.experiments import reproduce as module
from triform.experiments.demo import DemoConfig, run_demo
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.experiments.reproduce import KEYS, ReproduceConfig, run_reproduce
from triform.recordings.measure import MeasureConfig, run_measure
from triform.report.page import Section, read_sections, write_pages
from triform.types import ConfigurationError, TriformError


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(module, "SIZES", (5, 7))
    monkeypatch.setattr(module, "_CANDIDATES", 2)


def test_all_results_are_written_and_tied_together(tmp_path, listener):
    config = options(ReproduceConfig, controller="expert-sensed", what="all", output=tmp_path, runs=2, duration=27.0)
    pages = run_reproduce(config, listener)
    assert pages == [tmp_path / "index.md", tmp_path / "index.html"]
    # Emulated robots know no true poses.
    shown = listener.console.file.getvalue()
    for key in ("fig7", "fig8"):
        assert f"left out: {key}: no robot can know what the controller expert-sensed needs to know" in shown
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "index.md", "index.html", "table1.json", "table1.parquet",
        "fig2.json", "fig2.parquet", "fig2.png", "fig3.json", "fig3.parquet", "fig3.png",
        "fig4.json", "fig4.parquet", "fig4.png", "fig5.json", "fig5.parquet", "fig5.png", "fig9.json", "fig9.parquet",
        "fig9.png", *(f"fig{number}.pdf" for number in (2, 3, 4, 5, 9)),
    }  # fmt: skip
    markdown = pages[0].read_text()
    titles = re.findall(r"^## ([^:\n]*)", markdown, re.MULTILINE)
    assert titles == ["Table I", "Fig. 2", "Fig. 3", "Fig. 4", "Fig. 5", "Fig. 9"]
    assert "| 5 | 100 % |" in markdown
    linked = set(re.findall(r"\]\(([^)]+)\)", markdown))
    # Vector drawings are for papers.
    assert linked == {name for name in names if not name.startswith("index") and not name.endswith(".pdf")}
    page = pages[1].read_text()
    assert len(re.findall(r'src="data:image/png;base64,', page)) == 5
    assert "within 6 s and stays there" in page
    assert "http" not in page
    table = json.loads((tmp_path / "table1.json").read_text())
    assert table["paper"]["success"]["13"] == 1.0
    assert [result["robots"] for result in table["results"]] == [5, 7]
    assert table["hardware_profile"]["robots"] == 4
    poses = pd.read_parquet(tmp_path / "fig3.parquet")
    assert poses.groupby("robots").size().to_dict() == {5: 5 * 271, 7: 7 * 271}
    changes = json.loads((tmp_path / "fig5.json").read_text())["results"]
    assert [(entry["robots_before"], entry["robots_after"]) for entry in changes] == [(7, 8), (7, 6)]


def test_one_result_joins_those_already_there(tmp_path, listener):
    config = options(ReproduceConfig, controller="expert", what="fig3", output=tmp_path, runs=1, duration=6.0)
    run_reproduce(config, listener)
    run_reproduce(
        options(ReproduceConfig, controller="expert", what="fig4", output=tmp_path, runs=1, duration=6.0), listener
    )
    markdown = (tmp_path / "index.md").read_text()
    assert "## Fig. 3" in markdown
    assert "## Fig. 4" in markdown
    command = f"triform reproduce fig4 --controller expert --output {tmp_path} --runs 1 --seed 7"
    assert f"{command} --sight 3.0 --duration 6.0" in markdown


def test_a_foreign_file_of_that_name_is_refused(tmp_path):
    (tmp_path / "fig3.json").write_text('{"something": "else"}')
    with pytest.raises(TriformError, match=r"fig3\.json was not written by triform reproduce"):
        read_sections(tmp_path, ["fig3"])


def test_pages_escape_what_they_show(tmp_path):
    (tmp_path / "a.png").write_bytes(b"pixels")
    section = Section("a", "A <b>", "x & y", "run", ["h"], [["<1"]], "a.png", ["a.json"])
    page = write_pages(tmp_path, "Title", [section])[1].read_text()
    assert "A &lt;b&gt;" in page
    assert "x &amp; y" in page
    assert "&lt;1" in page
    assert base64.b64encode(b"pixels").decode() in page


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"controller": "expert", "duration": 37.5, "distance": 0.9, "profile": "hardware", "arena": "room-6"},
        {"controller": "policy:my policies/it's best", "runs": 5, "seed": 2, "output": Path("a b")},
    ],
)
def test_the_command_on_the_page_gives_the_same_settings(key, changes, monkeypatch):
    monkeypatch.setattr(module, "SIZES", (5, 7))
    config = options(ReproduceConfig, what=key, **changes)
    words = shlex.split(config.command(key))
    assert words[:3] == ["triform", "reproduce", key]
    again = tyro.cli(COMMANDS["reproduce"].load(), args=words[2:], config=CONFIG, registry=registry)
    for option in dataclasses.fields(config):
        assert getattr(again, option.name) == getattr(config, option.name), option.name


def test_defaults_are_not_said():
    assert ReproduceConfig().command("fig3") == "triform reproduce fig3 --controller policy:near --runs 100 --seed 7"


@pytest.mark.parametrize("formed", [True, False])
def test_the_page_says_which_change_is_shown(formed, tmp_path, listener, monkeypatch):
    run = Scenario.run

    def changed(scenario, *given, **options):
        trajectory, table = run(scenario, *given, **options)
        if scenario.event is not None and len(table["success"]) == 2:
            table["connected_start"][:] = True
            table["formed_before"][:] = [False, formed]
        return trajectory, table

    monkeypatch.setattr(Scenario, "run", changed)
    run_reproduce(
        options(ReproduceConfig, controller="expert", what="fig5", output=tmp_path, runs=2, duration=26.0), listener
    )
    text = (tmp_path / "index.md").read_text()
    if formed:
        assert "Above is start 1 of team size 6, the first that had formed" in text
        assert "below is start 1 of team size 7, the first that had formed" in text
    else:
        assert "Above is start 0 of team size 6, which had not formed before the change" in text
        assert "whose sensing graph is connected right after it: none of the first 2 starts" in text
    assert "within 5 s and stays there" in text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"what": "fig6"}, "what is 'fig6'"),
        ({"runs": 0}, "runs is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"duration": 25.0}, "the event comes at 21 s; a run of 25 s"),
        ({"what": "fig5", "duration": 21.0}, "the event comes at 21 s; a run of 21 s"),
        ({"what": "fig4", "duration": 4.0}, "duration is 4.0 s; a run is measured over its last 5 s"),
        ({"what": "fig4", "duration": 6.25}, "whole number of control periods of 0.1 s"),
        ({"what": "table1", "duration": 27.1}, "table1 also runs the profile 'hardware'"),
        ({"what": "fig7", "simulator": "mujoco"}, "Fig. 7 and 8 show emulated robots of the hardware profile as it is"),
        ({"what": "fig8", "range_noise": 0.1}, "Fig. 7 and 8 show emulated robots of the hardware profile as it is"),
    ],
)
def test_bad_settings_are_refused(changes, message):
    with pytest.raises(ConfigurationError, match=f"^[^\n]*{re.escape(message)}"):
        options(ReproduceConfig, **changes)


def test_durations_that_no_result_stumbles_over_are_taken():
    assert options(ReproduceConfig, duration=26.0).scenario.steps == 260
    assert options(ReproduceConfig, what="fig3", duration=5.1).scenario.steps == 51


def test_a_bad_folder_is_refused_before_anything_runs(tmp_path, listener):
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(TriformError, match="cannot write"):
        run_reproduce(options(ReproduceConfig, controller="expert", output=file), listener)
    with pytest.raises(TriformError, match="cannot write"):
        run_demo(options(DemoConfig, controller="expert", output=file / "sub"), listener)


def test_demo_prints_measures_and_the_paths_it_wrote(tmp_path, listener):
    config = options(DemoConfig, controller="expert-sensed", robots=4, duration=6.0, output=tmp_path)
    paths = run_demo(config, listener)
    video = ["demo.mp4"] if importlib.util.find_spec("av") else []
    page = ["demo.html"] if importlib.util.find_spec("viser") else []
    drawings = ["demo.png", "demo.pdf", "sight.png", "sight.pdf", "demo.gif"]
    assert [path.name for path in paths] == [*drawings, *video, "demo.json", *page, "run.parquet"]
    shown = listener.console.file.getvalue()
    for path in paths:
        assert path.exists()
        assert str(path) in shown
    assert "success" in shown
    with Image.open(tmp_path / "demo.gif") as image:
        assert image.n_frames > 5
    assert json.loads((tmp_path / "demo.json").read_text())["results"][0]["robots"] == 4


def test_demo_shows_any_run_of_an_evaluation(tmp_path, listener):
    scenario = {"controller": "expert-sensed", "duration": 6.0}
    evaluated = evaluate(options(EvaluateConfig, robots=(5,), runs=3, seed=4, **scenario))
    config = options(DemoConfig, robots=5, seed=4, index=2, output=tmp_path, **scenario)
    run_demo(config, listener)
    shown = json.loads((tmp_path / "demo.json").read_text())["results"][0]
    assert shown["formation_error_median"] == evaluated.runs["formation_error"][2]
    kept = run_measure(MeasureConfig((tmp_path / "run.parquet",))).runs
    for name in set(evaluated.runs) - {"run"}:
        np.testing.assert_array_equal(kept[name], evaluated.runs[name][2:], err_msg=name)
    with pytest.raises(ConfigurationError, match="index"):
        options(DemoConfig, index=-1)
