"""Tables of measures: Parquet for every run, a rich table for the eye, Markdown for pages."""

from __future__ import annotations

import importlib.util
import io
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from triform.evaluation.metrics import RunTable
from triform.report.output import write_bytes
from triform.types import TriformError


class Advance(Protocol):
    """Moves a progress bar forward."""

    def __call__(self, steps: float = 1) -> None:
        """Note that ``steps`` more steps are done."""
        ...


@contextmanager
def progress_bar(console: Console, description: str, total: float) -> Iterator[Advance]:
    """Show a progress bar with the time left while the block runs; it vanishes afterwards."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(description, total=total)
        yield lambda steps=1: progress.advance(task, steps)


def require_parquet() -> None:
    """Make sure that Parquet files can be written, before anything is computed for them.

    Raises:
        TriformError: pyarrow is not installed.
    """
    if importlib.util.find_spec("pyarrow") is None:
        raise TriformError("per-run tables need pyarrow, which is not installed: pip install 'triform[evaluate]'")


def write_parquet(path: Path, table: RunTable) -> Path:
    """Write one row per run to a Parquet file, atomically.

    Raises:
        TriformError: The file cannot be written, or pyarrow is not installed.
    """
    require_parquet()
    import pyarrow as pa
    from pyarrow import parquet

    buffer = io.BytesIO()
    parquet.write_table(pa.table({name: pa.array(column) for name, column in table.items()}), buffer)
    return write_bytes(path, buffer.getvalue())


def read_parquet(path: Path) -> RunTable:
    """Read what ``write_parquet`` wrote.

    Raises:
        TriformError: The file is no readable Parquet file, or pyarrow is not installed.
    """
    require_parquet()
    import pyarrow as pa
    from pyarrow import parquet

    try:
        table = parquet.read_table(io.BytesIO(path.read_bytes()))
    except (OSError, pa.ArrowException) as error:
        raise TriformError(f"{path} cannot be read: {error}") from None
    return {name: table[name].to_numpy() for name in table.column_names}


#: Heading, key in a summary and format of every column that people are shown; short, to fit a terminal.
_COLUMNS = (
    ("robots", "robots", "d"),
    ("runs", "runs", "d"),
    ("success", "success", "%"),
    ("sensed", "success_sensed", "%"),
    ("strict", "strict", "%"),
    ("hold", "strict_hold_mean", "%"),
    ("strict at", "strict_time_median", "s"),
    ("drift", "settled_speed_median", "cm/s"),
    ("median error", "formation_error_median", "%%"),
    ("95 % error", "formation_error_p95", "%%"),
    ("time", "converge_time_median", "s"),
    ("compact", "compactness_mean", "%"),
    ("closest", "min_distance", "m"),
    ("overlap", "collision", "%"),
)

#: Columns that a terminal of 80 characters has no room for.
WIDE = ("hold", "95 % error", "compact")

#: What the headings mean, for pages.
LEGEND = (
    "Success: the formation error, averaged over the last 5 s, is below 10 %; sensed: the same over pairs within "
    "2 d*; strict: the run ends in a true triangulation; hold: mean share of the last 5 s in which it is one; strict "
    "at: median time from which runs are one to the end; drift: median speed of their robots in the last 5 s; median "
    "and 95 % error: quantiles of the formation error; time: "
    "median converge time of the runs that converge; compact: edges over the most that so many robots can have; "
    "closest: smallest distance between two centres; overlap: runs in which two footprints ever overlapped."
)


def format_value(value: Any, kind: str) -> str:
    """Format a measure: ``d`` a count, ``%`` a rate, ``%%`` an error with a decimal; ``s``, ``m``, ``cm/s`` units."""
    if value is None or not math.isfinite(value):
        return "-"
    if kind == "%":
        return f"{100 * value:.0f} %"
    if kind == "%%":
        return f"{100 * value:.1f} %"
    if kind == "s":
        return f"{value:.1f} s"
    if kind == "m":
        return f"{value:.2f} m"
    if kind == "cm/s":
        return f"{100 * value:.1f} cm/s"
    return f"{value:{kind}}"


def summary_rows(summaries: Sequence[dict[str, Any]], without: Sequence[str] = ()) -> tuple[list[str], list[list[str]]]:
    """Return headings and formatted rows of summaries, one row per summary, but not the headings in ``without``."""
    headings = [heading for heading, _, _ in _COLUMNS]
    rows = [[format_value(summary[key], kind) for _, key, kind in _COLUMNS] for summary in summaries]
    return drop_columns(headings, rows, without)


def drop_columns(
    headings: Sequence[str], rows: Sequence[Sequence[str]], dropped: Sequence[str]
) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows without the columns whose headings are ``dropped``."""
    kept = [column for column, heading in enumerate(headings) if heading not in dropped]
    return [headings[column] for column in kept], [[row[column] for column in kept] for row in rows]


def rich_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Return a right-aligned table for a terminal."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, show_edge=False, padding=0)
    for heading in headings:
        # A unit in brackets is no markup.
        table.add_column(escape(heading), justify="right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a right-aligned Markdown table."""
    lines = [headings, ["---:"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
