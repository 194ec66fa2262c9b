"""The table: rows, and how they are written as Markdown and JSON."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from benchmarks.timing import Spread
from triform.files import make_folder, write_atomically

FORMAT, VERSION = "triform-bench", 1
#: Load average above which somebody else was using the machine.
BUSY = 1.0


@dataclass(frozen=True)
class Aim:
    """What a row should reach.

    Attributes:
        relation: Whether more or less is better.
        value: The limit, in the unit of the row.
    """

    relation: Literal[">=", "<="]
    value: float

    def reached(self, value: float) -> bool:
        """Whether a measured value reaches the aim."""
        return value >= self.value if self.relation == ">=" else value <= self.value


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        what: What was measured, and under which conditions.
        measured: The quantity; ``None`` where it could not be measured, and ``note`` says why.
        aim: What it should reach; ``None`` for figures that explain others.
        sides: Both sides of a comparison, or parts of the quantity, by name.
        note: What bounds it, and what a reader must know to compare.
    """

    what: str
    measured: Spread | None
    aim: Aim | None = None
    sides: dict[str, Spread] = field(default_factory=dict)
    note: str = ""

    @property
    def reached(self) -> bool | None:
        """Whether the median reaches the aim; ``None`` without an aim or a measurement."""
        return None if self.aim is None or self.measured is None else self.aim.reached(self.measured.median)


@dataclass
class GroupResult:
    """What came of one group.

    Attributes:
        name: The group.
        title: Its heading.
        rows: Rows that were finished.
        seconds: Time that it took [s].
        load_before: Load average of the machine over one minute before it.
        failure: Why it did not finish.
    """

    name: str
    title: str
    rows: list[Row] = field(default_factory=list)
    seconds: float = 0.0
    load_before: float = math.nan
    failure: str | None = None

    def as_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        values = asdict(self)
        values["rows"] = [{**asdict(row), "reached": row.reached} for row in self.rows]
        return values


def number(value: float) -> str:
    """A number with three significant digits and separated thousands."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    rounded = round(value, 2 - math.floor(math.log10(abs(value))))
    return f"{rounded:,.{digits}f}"


def write_report(folder: Path, machine: dict[str, Any], groups: list[GroupResult], quick: bool) -> None:
    """Write ``bench.json`` and ``bench.md``.

    Raises:
        TriformError: If the folder cannot be written.
    """
    make_folder(folder)
    content = {
        "format": FORMAT,
        "version": VERSION,
        "quick": quick,
        "machine": machine,
        "groups": [group.as_json() for group in groups],
    }
    write_atomically(folder / "bench.json", (json.dumps(content, indent=2) + "\n").encode())
    write_atomically(folder / "bench.md", markdown(machine, groups, quick).encode())


def markdown(machine: dict[str, Any], groups: list[GroupResult], quick: bool) -> str:
    """The whole report as Markdown."""
    aimed = [row for group in groups for row in group.rows if row.aim is not None]
    lines = ["# Benchmarks", "", "Written by `make bench`. Medians; in brackets the quartiles over the turns.", ""]
    if quick:
        lines += ["**A quick run: it shows that everything works, and measures nothing well.**", ""]
    if groups and groups[0].load_before > BUSY:
        lines += [f"**The machine was busy: a load of {groups[0].load_before:.2f} before the first group.**", ""]
    lines += [f"{sum(bool(row.reached) for row in aimed)} of {len(aimed)} aims reached.", ""]
    lines += ["## Machine", "", "| | |", "|---|---|"]
    lines += [f"| {_cell(name)} | {_cell(_plain(value))} |" for name, value in machine.items()]
    for group in groups:
        lines += ["", f"## {group.title}", ""]
        if group.failure is not None:
            lines += [f"**This group failed:** {_cell(group.failure)}", ""]
        if group.rows:
            lines += ["| what | aim | measured | sides | reached | what bounds it |", "|---|---|---|---|---|---|"]
            lines += [_line(row) for row in group.rows]
        lines += ["", f"`--only {group.name}`: {group.seconds:.0f} s, load {group.load_before:.2f} before."]
    return "\n".join(lines) + "\n"


def _line(row: Row) -> str:
    aim = "" if row.aim is None else f"{'≥' if row.aim.relation == '>=' else '≤'} {_amount(row.aim.value, row)}"
    measured = "not measured" if row.measured is None else _spread(row.measured)
    sides = "<br>".join(f"{_cell(name)}: {_spread(spread)}" for name, spread in row.sides.items())
    reached = {None: "", True: "yes", False: "**no**"}[row.reached]
    return f"| {_cell(row.what)} | {aim} | {measured} | {sides} | {reached} | {_cell(row.note)} |"


def _amount(value: float, row: Row) -> str:
    return f"{value:,g} {row.measured.unit}" if row.measured else f"{value:,g}"


def _spread(spread: Spread) -> str:
    median = f"{number(spread.median)} {spread.unit}"
    return median if spread.repeats == 1 else f"{median} ({number(spread.lower)} to {number(spread.upper)})"


def _plain(value: object) -> str:
    return ", ".join(f"{name} {each}" for name, each in value.items()) if isinstance(value, dict) else str(value)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
