"""A result of the paper before it is written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from triform.evaluation.metrics import RunTable
from triform.experiments.emulated import EmulatedRun


@dataclass(frozen=True)
class Result:
    """A result before it is written.

    Attributes:
        title: Heading.
        text: What is shown and how to read it.
        table: Headings and formatted rows.
        runs: Data, one row per run or record.
        values: Measures, plain JSON values.
        figure: The drawing; ``None`` for a table alone.
        kept: Runs that are kept instead of ``runs``.
    """

    title: str
    text: str
    table: tuple[list[str], list[list[str]]]
    runs: RunTable
    values: dict[str, Any]
    figure: Figure | None = None
    kept: Sequence[EmulatedRun] = ()
