"""What a terminal shows of tables."""

from __future__ import annotations

from io import StringIO

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from triform.commands.terminal import Terminal

HEADINGS = ["robots", "strict at", "median error", "changed"]
rates = st.tuples(st.integers(0, 100), st.integers(0, 50), st.integers(50, 100)).map(
    lambda given: "{} % ({}-{})".format(*given)
)
cells = st.one_of(rates, st.just("-"), st.integers(0, 400).map(lambda time: f"{time / 10} s"), st.just("sight 2.0 d*"))


def show(headings, rows, width, note=""):
    console = Console(file=StringIO(), width=width)
    Terminal(console).table("The title", headings, rows, note)
    title, *lines = console.file.getvalue().splitlines()
    assert title == "The title"
    return lines


@given(st.data(), st.integers(1, 12), st.integers(1, 4), st.integers(30, 120))
def test_a_table_fits_its_terminal_and_loses_nothing(data, columns, count, width):
    headings = [data.draw(st.sampled_from(HEADINGS)) for _ in range(columns)]
    rows = [[str(number), *(data.draw(cells) for _ in range(columns - 1))] for number in range(count)]
    lines = show(headings, rows, width)
    assert max(map(len, lines)) <= width
    words = " ".join(lines).split()
    for row in rows:
        for word in " ".join(row).split():
            assert word in words


def test_numbers_keep_their_units_and_intervals_go_below():
    lines = show(["team", "strict", "time"], [["a", "100 % (96-100)", "12.5 s"], ["b", "7 % (4-12)", "8.0 s"]], 20)
    assert [line.split() for line in lines if "%" in line] == [
        ["a", "100", "%", "12.5", "s"],
        ["b", "7", "%", "8.0", "s"],
    ]
    assert [line.strip() for line in lines if "-" in line] == ["(96-100)", "(4-12)"]


@pytest.mark.parametrize("width", [40, 80])
def test_a_table_in_parts_repeats_its_first_column(width):
    headings = ["controller", *map(str, range(12)), "p"]
    rows = [[name, *["100 % (96-100)"] * 12, "<0.001"] for name in ("expert", "policy")]
    lines = show(headings, rows, width, "The note.")
    assert lines[-1] == "The note."
    first = [line.split()[0] for line in lines[:-1] if line.split()[0] in ("controller", "expert", "policy")]
    parts = first.count("controller")
    assert parts > 1
    assert first == ["controller", "expert", "policy"] * parts
    assert sum("<0.001" in line for line in lines) == 2


def test_a_wide_terminal_breaks_no_line():
    lines = show(["team", "strict"], [["a", "100 % (96-100)"]], 80)
    assert [line.split() for line in lines if "a" in line.split()] == [["a", "100", "%", "(96-100)"]]


def test_a_table_without_rows_has_its_headings():
    assert show(["team", "strict"], [], 80)[0].split() == ["team", "strict"]
