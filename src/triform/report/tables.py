"""Tables of measures: Parquet for every run, formatted rows for the eye, Markdown for pages."""

from __future__ import annotations

import importlib.util
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from triform.evaluation.metrics import RunTable
from triform.files import write_atomically
from triform.types import TriformError


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
    write_atomically(path, buffer.getvalue())
    return path


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
    ("strict sensed", "strict_sensed", "%"),
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
WIDE = ("strict sensed", "hold", "drift", "95 % error", "compact")

#: What the headings of tables mean.
MEANINGS = {
    "success": "the formation error, averaged over the last 5 s, is below 10 %",
    "sensed": "success over pairs within 2 d*",
    "strict": "the run ends in a true triangulation",
    "strict sensed": "strict over pairs within 2 d*",
    "hold": "mean share of the last 5 s in which a run is strict",
    "strict at": "median time from which runs are strict to the end",
    "drift": "median speed of strict robots in the last 5 s",
    "median error": "median of the formation error",
    "95 % error": "95 % quantile of the formation error",
    "time": "median converge time of the runs that converge",
    "compact": "edges over the most that so many robots can have",
    "closest": "smallest distance between two centres",
    "overlap": "runs in which two footprints ever overlapped",
    "formed before": "success over the last 5 s before the event",
    "back": "success after the event",
    "linked": "right after the event the pairs within 2 d* connect all robots",
    "back if linked": "success among the linked runs",
    "recovery time": "median time from the event to convergence, at least 5 s",
}


#: What the brackets behind rates hold.
BRACKETS = "Brackets hold Wilson's 95 % interval of a rate."


def legend(headings: Sequence[str]) -> str:
    """Return what the headings of a table and the brackets behind its rates mean, but not what speaks for itself."""
    known = "; ".join(f"{heading}: {MEANINGS[heading]}" for heading in headings if heading in MEANINGS)
    return f"{known[:1].upper()}{known[1:]}. {BRACKETS}" if known else ""


#: Factor, decimals and unit of every kind of measure.
_FORMATS = {
    "d": (1, "d", ""),
    "%": (100, ".0f", " %"),
    "%%": (100, ".1f", " %"),
    "s": (1, ".1f", " s"),
    "m": (1, ".2f", " m"),
    "cm/s": (100, ".1f", " cm/s"),
}


def format_value(value: Any, kind: str) -> str:
    """Format a measure: ``d`` a count, ``%`` a rate, ``%%`` an error with a decimal; ``s``, ``m``, ``cm/s`` units."""
    if value is None or not math.isfinite(value):
        return "-"
    factor, decimals, unit = _FORMATS[kind]
    return f"{factor * value:{decimals}}{unit}"


def format_measure(summary: Mapping[str, Any], key: str, kind: str) -> str:
    """Format a measure of a summary; a rate with its interval, such as ``97 % (92-99)``."""
    text = format_value(summary[key], kind)
    if kind != "%" or text == "-" or f"{key}_interval" not in summary:
        return text
    low, high = summary[f"{key}_interval"]
    return f"{text} ({100 * low:.0f}-{100 * high:.0f})"


def summary_rows(summaries: Sequence[dict[str, Any]], without: Sequence[str] = ()) -> tuple[list[str], list[list[str]]]:
    """Return headings and formatted rows of summaries, one row per summary, but not the headings in ``without``."""
    headings = [heading for heading, _, _ in _COLUMNS]
    rows = [[format_measure(summary, key, kind) for _, key, kind in _COLUMNS] for summary in summaries]
    return drop_columns(headings, rows, without)


#: Columns for runs that an event interrupts.
_EVENT_COLUMNS = (
    ("runs", "runs", "d"),
    ("formed before", "formed_before", "%"),
    ("back", "recovered", "%"),
    ("linked", "connected", "%"),
    ("back if linked", "recovered_connected", "%"),
    ("sensed", "recovered_sensed", "%"),
    ("strict", "strict", "%"),
    ("recovery time", "recovery_time_median", "s"),
    ("median error", "formation_error_median", "%%"),
    ("closest", "min_distance", "m"),
    ("overlap", "collision", "%"),
)


def event_rows(summaries: Sequence[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return headings and formatted rows of summaries of runs that an event interrupts."""
    headings = ["change", *(heading for heading, _, _ in _EVENT_COLUMNS)]
    rows = [
        [
            f"{summary['robots_before']} → {summary['robots_after']}",
            *(format_measure(summary, key, kind) for _, key, kind in _EVENT_COLUMNS),
        ]
        for summary in summaries
    ]
    return headings, rows


def drop_columns(
    headings: Sequence[str], rows: Sequence[Sequence[str]], dropped: Sequence[str]
) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows without the columns whose headings are ``dropped``."""
    kept = [column for column, heading in enumerate(headings) if heading not in dropped]
    return [headings[column] for column in kept], [[row[column] for column in kept] for row in rows]


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a right-aligned Markdown table."""
    lines = [headings, ["---:"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


#: Legend of the tables of runs, for pages.
LEGEND = legend([heading for heading, _, _ in _COLUMNS])
