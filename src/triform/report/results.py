"""Results of an evaluation: tables of runs, their summaries, their machine-readable form."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from triform.evaluation.metrics import RunTable, concatenate, select, summarise, summarise_median, summarise_rate
from triform.report.listener import Listener
from triform.report.output import prepare_file, write_json
from triform.report.tables import WIDE, event_rows, legend, require_parquet, summary_rows, write_parquet


@dataclass
class Evaluation:
    """What an evaluation found so far.

    Attributes:
        config: Settings and the controller's own description, plain JSON values.
        tables: One table per team size that is done, in the order of the configuration, one row per run.
        wall_seconds: Time spent [s].
    """

    config: dict[str, Any]
    tables: list[RunTable] = field(default_factory=list)
    wall_seconds: float = 0.0

    @property
    def results(self) -> list[dict[str, Any]]:
        """One summary per team size, over the runs in which no robot started out of everybody's sight.

        With an event that interrupts the runs, over all runs, and with the measures of ``summarise_event``.
        """
        return [
            summarise_event(table) if "robots_before" in table else self._summary(table, connected=True)
            for table in self.tables
        ]

    @property
    def disconnected_starts(self) -> list[dict[str, Any]]:
        """The same over the other runs, whose teams cannot know that they are one; only sizes that have any."""
        return [
            self._summary(table, connected=False)
            for table in self.tables
            if "robots_before" not in table and not table["connected_start"].all()
        ]

    @property
    def runs(self) -> RunTable:
        """All runs of all sizes in one table."""
        return concatenate(self.tables)

    def as_json(self) -> dict[str, Any]:
        """Return the machine-readable form."""
        return {
            "config": self.config,
            "wall_seconds": round(self.wall_seconds, 3),
            "results": self.results,
            "disconnected_starts": self.disconnected_starts,
        }

    @staticmethod
    def _summary(table: RunTable, connected: bool) -> dict[str, Any]:
        chosen = select(table, table["connected_start"] == connected)
        return {"robots": int(table["robots"][0]), **summarise(chosen)}


class ResultFiles:
    """The files of an evaluation: its summary, and one row per run beside it unless it has a place of its own."""

    def __init__(self, json: Path | None, parquet: Path | None) -> None:
        """Make sure that the files can be written, before anything is computed for them.

        Args:
            json: File for the summary; no file if ``None``.
            parquet: File for one row per run; beside the summary if ``None``, or no file if there is no summary.

        Raises:
            TriformError: A file cannot be written, or pyarrow is not installed.
        """
        self._json = json
        self._parquet = json.with_suffix(".parquet") if parquet is None and json is not None else parquet
        self.paths = [path for path in (self._json, self._parquet) if path is not None]
        for path in self.paths:
            prepare_file(path)
        if self._parquet is not None:
            require_parquet()

    def write(self, evaluation: Evaluation) -> None:
        """Write what was found so far."""
        if self._json is not None:
            write_json(self._json, evaluation.as_json())
        if self._parquet is not None:
            write_parquet(self._parquet, evaluation.runs)


def summarise_event(table: RunTable) -> dict[str, Any]:
    """Summarise runs that an event interrupts.

    ``recovered`` is the share of runs whose 5 s mean of the formation error is back below 10 % and stays there
    to the end; ``recovered_connected`` is the same share among the runs in which the pairs within sensing range
    still connect everybody right after the event: the others are teams that cannot know of each other. ``strict`` and
    ``strict_connected`` say the same of runs that end in a triangulation.

    Args:
        table: Measures of runs of one team size with one event.

    Returns:
        Rates as fractions, times in seconds.
    """
    connected = table["connected_start"].astype(np.bool_)
    whole, together = summarise(table), summarise(select(table, connected))
    # Under the name of the event, what holds of its end.
    again = {"recovered": (whole, "success"), "recovered_sensed": (whole, "success_sensed")}
    again |= {"recovered_connected": (together, "success"), "strict_connected": (together, "strict")}
    return {
        "robots": int(table["robots_before"][0]),
        "robots_before": int(table["robots_before"][0]),
        "robots_after": int(table["robots"][0]),
        **whole,
        **summarise_rate("formed_before", table["formed_before"]),
        **summarise_rate("strict_before", table["strict_before"]),
        **summarise_rate("connected", connected),
        **{f"{name}{end}": of[f"{key}{end}"] for name, (of, key) in again.items() for end in ("", "_interval")},
        **summarise_median("recovery_time", table["recovery_time"]),
        **summarise_median("strict_recovery_time", table["strict_recovery_time"]),
    }


def show_results(evaluation: Evaluation, name: str, listener: Listener) -> None:
    """Show the table of measures, and that of disconnected starts if there are any."""
    title = f"{name}, {evaluation.wall_seconds:.1f} s"
    if any("robots_before" in table for table in evaluation.tables):
        headings, rows = event_rows(evaluation.results)
        listener.table(title, headings, rows, legend(headings))
        return
    headings, rows = summary_rows(evaluation.results, WIDE)
    listener.table(title, headings, rows, legend(headings))
    if any(result["robots"] < 3 for result in evaluation.results):
        listener.say("a team of one or two robots has no triangle, so it can be a success but never strict")
    if evaluation.disconnected_starts:
        apart = summary_rows(evaluation.disconnected_starts, WIDE)
        listener.table(f"{name}, starts whose sensing graph is not connected", *apart)
