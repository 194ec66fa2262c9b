"""The benchmark's machinery: timing in turns, the report, groups that fail. No test looks at how fast anything is."""

from __future__ import annotations

import itertools
import json
import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from benchmarks.__main__ import main
from benchmarks.groups import GROUPS, measure_module
from benchmarks.machine import describe
from benchmarks.report import Aim, GroupResult, Row, number, write_report
from benchmarks.runner import Group, run
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Side, Spread, compare

QUICK = Settings(quick=True, cores=1)


def ignore(_what: str, _done: int, _total: int) -> None:
    """Watches nothing."""


def one_row(settings: Settings, watch: Watch) -> Iterator[Row]:
    watch("counting", 0, 1)
    yield Row(
        "a count | of things", Spread.of(np.arange(5.0), "things"), Aim(">=", 3), {"one": Spread.once(1, "x")}, "!"
    )


def breaks(settings: Settings, watch: Watch) -> Iterator[Row]:
    yield Row("before it broke", Spread.once(2.0, "s"), Aim("<=", 3))
    raise ValueError("something is wrong")


def crashes(settings: Settings, watch: Watch) -> Iterator[Row]:
    os._exit(3)
    yield Row("never", None)


def test_groups_that_fail_lose_no_other(tmp_path: Path) -> None:
    groups = [Group(f.__name__, f"Group {f.__name__}", f) for f in (breaks, crashes, one_row)]
    results = run(groups, QUICK, tmp_path, Console(quiet=True))
    assert [result.failure is None for result in results] == [False, False, True]
    found = json.loads((tmp_path / "bench.json").read_text())
    assert (found["format"], found["version"], found["quick"]) == ("triform-bench", 1, True)
    broken, crashed, good = found["groups"]
    assert broken["failure"] == "ValueError: something is wrong"
    assert [row["what"] for row in broken["rows"]] == ["before it broke"]
    assert broken["rows"][0]["reached"] is True
    assert crashed["rows"] == []
    assert "ended" in crashed["failure"]
    assert good["failure"] is None
    (row,) = good["rows"]
    assert row["aim"] == {"relation": ">=", "value": 3}
    assert row["measured"] == {
        "unit": "things", "median": 2.0, "lower": 1.0, "upper": 3.0, "least": 0.0, "most": 4.0, "repeats": 5,
    }  # fmt: skip
    assert row["reached"] is False
    text = (tmp_path / "bench.md").read_text()
    assert "1 of 2 aims reached" in text
    assert "**This group failed:** ValueError: something is wrong" in text
    line = r"| a count \| of things | ≥ 3 things | 2.00 things (1.00 to 3.00) | one: 1.00 x | **no** | ! |"
    assert line in text.splitlines()


def test_the_report_is_written_after_each_group(tmp_path: Path) -> None:
    seen = []

    class Watching(Console):
        def rule(self, *args: object, **kwargs: object) -> None:
            path = tmp_path / "bench.json"
            seen.append(len(json.loads(path.read_text())["groups"]) if path.exists() else 0)

    run([Group("a", "A", one_row), Group("b", "B", one_row)], QUICK, tmp_path, Watching(quiet=True))
    assert seen == [0, 1]


def test_sides_take_turns() -> None:
    calls: list[str] = []
    sides = [Side("a", lambda: calls.append("a"), 2.0), Side("b", lambda: calls.append("b"))]
    settings = Settings(quick=True)
    seconds = compare(sides, settings, ignore, "turns")
    assert list(seconds) == ["a", "b"]
    assert all(each.shape == (settings.rounds,) and (each > 0).all() for each in seconds.values())
    changes = sum(first != second for first, second in itertools.pairwise(calls))
    # Two calls of each to estimate, then every turn of each side in one piece.
    assert changes == 1 + 2 * settings.rounds


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0"), (1234567, "1,230,000"), (999.6, "1,000"), (12.345, "12.3"), (0.04567, "0.0457"),
        (-2.5, "-2.50"), (math.inf, "inf"),
    ],
)  # fmt: skip
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_a_row_without_measurement_says_why(tmp_path: Path) -> None:
    row = Row("a peer", None, Aim(">=", 40), note="it is not installed")
    assert row.reached is None
    write_report(tmp_path, {"processor": "any"}, [GroupResult("a", "A", [row])], quick=False)
    assert "| a peer | ≥ 40 | not measured |  |  | it is not installed |" in (tmp_path / "bench.md").read_text()
    assert json.loads((tmp_path / "bench.json").read_text())["groups"][0]["rows"][0]["measured"] is None


def test_the_machine_is_described() -> None:
    machine = describe(1)
    assert {"processor", "caches", "memory", "packages", "commit", "date", "load before"} <= set(machine)
    assert json.loads(json.dumps(machine)) == machine


def test_peers_that_are_missing_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("vmas", "irsim"):
        monkeypatch.setitem(sys.modules, name, None)
        monkeypatch.delitem(sys.modules, f"benchmarks.peers.{name}_lidar", raising=False)
    rows = list(measure_module("scans", QUICK, ignore))
    assert [row.measured for row in rows] == [None, None]
    assert [row.note.split()[0] for row in rows] == ["vmas", "irsim"]


@pytest.mark.parametrize("name", ["maps", "step"])
def test_quick_groups_give_rows(name: str) -> None:
    rows = list(measure_module(name, QUICK, ignore))
    assert rows
    assert all(row.measured is not None and row.measured.median > 0 for row in rows)


def test_wrong_usage_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for wrong, message in ((["--only", "nothing"], "there is no group nothing"), (["--cores", "0"], "cores is 0")):
        with pytest.raises(SystemExit) as stopped:
            main([*wrong, "--output", str(tmp_path)])
        assert stopped.value.code == 2
        assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_every_group_is_named_after_itself() -> None:
    assert all(name == group.name and group.title for name, group in GROUPS.items())
