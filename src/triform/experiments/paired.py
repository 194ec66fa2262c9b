"""Rows of a table against the first one, run by run: what differs by more than chance on the same starts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triform.evaluation.metrics import RunTable, concatenate
from triform.evaluation.statistics import differences, holm, mcnemar, signed_rank
from triform.experiments.cell import Cell
from triform.experiments.grid import Grid

_Test = Callable[[NDArray[Any], NDArray[Any]], float]
#: How rates and values of runs are compared.
_RATE: tuple[str, _Test] = ("McNemar", mcnemar)
_VALUE: tuple[str, _Test] = ("Wilcoxon signed-rank", signed_rank)
#: The test of every measure that is compared.
_TESTS = {
    "strict": _RATE, "success": _RATE, "strict_time": _VALUE, "converge_time": _VALUE, "formation_error": _VALUE,
}  # fmt: skip
#: How a row says that it is what others are compared with.
_REFERENCE = "ref"
#: What p-values mean, whatever the table.
MEANING = (
    "p is the chance of a difference at least as large if there were none, from the same starts run by run: below 0.05 "
    "a difference is hardly chance, above it nothing is shown. Rates by McNemar's exact test, times and errors by "
    "Wilcoxon's signed-rank test over the runs that have both, with Holm's correction for all comparisons in a column."
)


@dataclass(frozen=True)
class Row:
    """A row of a table, compared with another row on the same starts.

    Attributes:
        key: What tells the row from others, by the names in the cells' labels.
        reference: Label of the row that it is compared with.
        tests: By measure, ``test``, ``pairs`` of runs that have the measure both ways, in how many of them it is
            ``higher`` and ``lower`` than in the reference, ``p``, and ``p_holm`` for all rows of the table.
    """

    key: Mapping[str, str | int]
    reference: str
    tests: Mapping[str, dict[str, Any]]

    def as_json(self) -> dict[str, Any]:
        """Return the row as it is written into a file."""
        return {**self.key, "reference": self.reference, **self.tests}


def compare_rows(grid: Grid, cells: Sequence[Cell], by: Sequence[str] = ("label",)) -> list[Row]:
    """Compare every row of a table with the first one that ran the same starts.

    The cells of a row are pooled: pairs are runs of the same cell but for its label, with the same index.

    Args:
        grid: Holds the runs.
        cells: The cells of one table in their order, done or not.
        by: What tells the rows from each other: names of labels, or ``robots``.

    Returns:
        A row for each that has pairs, in order; none for the reference itself.
    """
    references: dict[Any, Cell] = {}
    # By row and column, so that a column that is asked for twice counts once.
    pairs: dict[tuple[Any, ...], dict[Any, tuple[RunTable, RunTable]]] = {}
    names: dict[tuple[Any, ...], str] = {}
    for cell in cells:
        reference = references.setdefault(_column(cell), cell)
        if cell.labels["label"] != reference.labels["label"] and grid.is_done(cell) and grid.is_done(reference):
            key = tuple({**cell.labels, "robots": cell.robots}[name] for name in by)
            pairs.setdefault(key, {})[_column(cell)] = _align(grid.table(reference), grid.table(cell))
            names[key] = reference.labels["label"]
    tests = [_test(list(own.values())) for own in pairs.values()]
    for measure in _TESTS:
        adjusted = holm([each[measure]["p"] for each in tests])
        for each, p in zip(tests, adjusted, strict=True):
            each[measure]["p_holm"] = p
    return [Row(dict(zip(by, key, strict=True)), names[key], each) for key, each in zip(pairs, tests, strict=True)]


def format_p(rows: Sequence[Row], measure: str, **key: str | int) -> str:
    """Return Holm's p-value of a row that has such a key; ``ref`` for a reference, a dash if nothing is known."""
    for row in rows:
        if row.key == key:
            p = row.tests[measure]["p_holm"]
            return "-" if math.isnan(p) else "<0.001" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"
    return _REFERENCE if any({**row.key, "label": row.reference} == key for row in rows) else "-"


def explain_p(rows: Sequence[Row], meaning: bool = True) -> str:
    """Return with what the rows of a table are compared, how many are, and what p means; nothing if none is.

    Args:
        rows: What ``compare_rows`` returned.
        meaning: Whether to say what p means.
    """
    if not rows:
        return ""
    references = {row.reference for row in rows}
    pooled = "robots" not in rows[0].key
    which = f"{references.pop()}, all columns together" if pooled else "the first row with as many robots"
    counted = f"p: {len(rows)} comparison{'s' * (len(rows) > 1)} with {which} ({_REFERENCE})."
    return f"{counted} {MEANING}" if meaning else counted


def _column(cell: Cell) -> Any:
    """What two cells share whose runs are pairs: all labels but one, and the starts."""
    others = tuple(value for name, value in cell.labels.items() if name != "label")
    return *others, cell.starts_key


def _align(first: RunTable, second: RunTable) -> tuple[RunTable, RunTable]:
    """Return the rows of the runs that both tables have, in the same order."""
    _, ours, theirs = np.intersect1d(first["run"], second["run"], assume_unique=True, return_indices=True)
    return {name: first[name][ours] for name in _TESTS}, {name: second[name][theirs] for name in _TESTS}


def _test(pairs: Sequence[tuple[RunTable, RunTable]]) -> dict[str, dict[str, Any]]:
    """Test all measures of the pairs of a row."""
    first, second = (concatenate(tables) for tables in zip(*pairs, strict=True))
    found = {}
    for measure, (name, test) in _TESTS.items():
        gains = differences(first[measure], second[measure])
        found[measure] = {
            "test": name,
            "pairs": len(gains),
            "higher": int((gains > 0).sum()),
            "lower": int((gains < 0).sum()),
            "p": test(first[measure], second[measure]),
        }
    return found
