"""The command: what it refuses, and what it says where viser is missing."""

from __future__ import annotations

import sys

import pytest

from triform.cli import main
from triform.recordings.resample import read_recordings
from triform.simulation import get_arena
from triform.viewer.view import ViewConfig, stage_of


def test_without_viser_one_sentence_says_what_to_install(tmp_path, monkeypatch, capsys) -> None:
    # The options stay: their module is read again for the help text. What draws is imported anew.
    for name in [each for each in sys.modules if each.startswith("triform.viewer.") and each != ViewConfig.__module__]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", "--html", str(tmp_path / "run.html")]) == 1
    shown = capsys.readouterr().err.strip()
    assert "view needs viser, which the extra 'view' installs: pip install 'triform[view]'" in shown
    assert len(shown.splitlines()) == 1
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--port", "0"], "port is 0"),
        (["--which", "1"], "which and rate are of recorded runs"),
        (["--robots", "1000"], "a page shows 1 to 300"),
        (["--event", "join"], "events are made by hand"),
        (["--simulator", "gazebo"], "built-in world or MuJoCo"),
    ],
)
def test_wrong_options_are_wrong_usage(options: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["view", *options])
    assert ended.value.code == 2
    assert says in " ".join(capsys.readouterr().err.replace("│", " ").split())


def test_a_kept_run_is_drawn_with_the_distance_and_arena_that_it_had(tmp_path) -> None:
    kept = tmp_path / "run.parquet"
    scenario = ["--arena", "room-6", "--distance", "0.8", "--duration", "5", "--controller", "expert"]
    assert main(["evaluate", "--robots", "4", "--runs", "1", "--keep", str(kept), *scenario]) == 0
    config = ViewConfig(kept)
    (recording,) = read_recordings(kept)
    stage = stage_of(config, recording.trajectory, recording)
    assert stage.distance == 0.8
    assert len(stage.arena.walls) == len(get_arena("room-6").walls) > 0
    assert stage_of(config, recording.trajectory, None).distance == 1.0
