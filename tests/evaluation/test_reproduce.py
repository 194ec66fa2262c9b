from __future__ import annotations

import base64
import json
import re

import pandas as pd
import pytest
from PIL import Image

from triform.evaluation import reproduce as module
from triform.evaluation.demo import DemoConfig, run_demo
from triform.evaluation.page import Section, read_sections, write_pages
from triform.evaluation.reproduce import ReproduceConfig, reproduce
from triform.types import ConfigurationError, TriformError


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(module, "SIZES", (5, 7))
    monkeypatch.setattr(module, "_CANDIDATES", 2)


def test_all_results_are_written_and_tied_together(tmp_path, console):
    config = ReproduceConfig(controller="expert-sensed", what="all", output=tmp_path, runs=2, duration=27.0)
    pages = reproduce(config, console)
    assert pages == [tmp_path / "index.md", tmp_path / "index.html"]
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "index.md", "index.html", "table1.json", "table1.parquet", "fig3.json", "fig3.parquet", "fig3.png",
        "fig4.json", "fig4.parquet", "fig4.png", "fig5.json", "fig5.parquet", "fig5.png",
    }  # fmt: skip
    markdown = pages[0].read_text()
    assert re.findall(r"^## (.*?):", markdown, re.MULTILINE) == ["Table I", "Fig. 3", "Fig. 4", "Fig. 5"]
    assert "| 5 | 100 % |" in markdown
    linked = set(re.findall(r"\]\(([^)]+)\)", markdown))
    assert linked == names - {"index.md", "index.html"}
    page = pages[1].read_text()
    assert len(re.findall(r'src="data:image/png;base64,', page)) == 3
    assert "http" not in page
    table = json.loads((tmp_path / "table1.json").read_text())
    assert table["paper"]["success"]["13"] == 1.0
    assert [result["robots"] for result in table["results"]] == [5, 7]
    assert table["hardware_profile"]["robots"] == 4
    poses = pd.read_parquet(tmp_path / "fig3.parquet")
    assert poses.groupby("robots").size().to_dict() == {5: 5 * 271, 7: 7 * 271}
    changes = json.loads((tmp_path / "fig5.json").read_text())["results"]
    assert [(entry["robots_before"], entry["robots_after"]) for entry in changes] == [(7, 8), (7, 6)]


def test_one_result_joins_those_already_there(tmp_path, console):
    config = ReproduceConfig(controller="expert", what="fig3", output=tmp_path, runs=1, duration=6.0)
    reproduce(config, console)
    reproduce(ReproduceConfig(controller="expert", what="fig4", output=tmp_path, runs=1, duration=6.0), console)
    markdown = (tmp_path / "index.md").read_text()
    assert "## Fig. 3" in markdown
    assert "## Fig. 4" in markdown
    assert "triform reproduce fig4 --controller expert --runs 1 --seed 7" in markdown


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


@pytest.mark.parametrize("changes", [{"what": "fig9"}, {"runs": 0}, {"seed": -1}])
def test_bad_settings_are_refused(changes):
    with pytest.raises(ConfigurationError):
        ReproduceConfig(**changes)


def test_a_bad_folder_is_refused_before_anything_runs(tmp_path, console):
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(TriformError, match="cannot write"):
        reproduce(ReproduceConfig(controller="expert", output=file), console)
    with pytest.raises(TriformError, match="cannot write"):
        run_demo(DemoConfig(controller="expert", output=file / "sub"), console)


def test_demo_prints_measures_and_the_paths_it_wrote(tmp_path, console):
    config = DemoConfig(controller="expert-sensed", robots=4, duration=6.0, output=tmp_path)
    paths = run_demo(config, console)
    assert [path.name for path in paths] == ["demo.png", "demo.gif", "demo.json"]
    shown = console.file.getvalue()
    for path in paths:
        assert path.exists()
        assert str(path) in shown
    assert "success" in shown
    with Image.open(paths[1]) as image:
        assert image.n_frames > 5
    assert json.loads(paths[2].read_text())["results"][0]["robots"] == 4
