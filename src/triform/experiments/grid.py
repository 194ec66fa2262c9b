"""Tables of many cells, each one controller with one team size in one scenario: measured once and kept in a file."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from triform import __version__
from triform.control import control_steps
from triform.engines import Engine, Report
from triform.evaluation.metrics import RunTable, concatenate, summarise, wilson_interval
from triform.evaluation.runs import Chunk, MeasureRuns, PicklableController, measure_groups
from triform.evaluation.scenario import Scenario
from triform.experiments.evaluate import describe
from triform.report.output import plain
from triform.report.tables import format_value, progress_bar, read_parquet, write_parquet
from triform.types import ConfigurationError, Controller, PrivilegedView, TriformError

#: Teams of more robots than this get so many times the duration, for they have farther to go.
LARGE_TEAM = 13
LARGE_TEAM_TIME = 3
#: Settings of a command that say nothing about results.
UNRECORDED = ("output", "engine", "ray_address", "threads")
#: Columns of the table of runs that say which cell a run belongs to.
_KEYS = ("label", "profile", "team", "settings")


@dataclass(frozen=True)
class RunCell:
    """One controller with one team size in one scenario: what is run many times.

    Attributes:
        label: What people call the controller.
        scenario: Everything about a run but its start.
        robots: Robots of the team.
        runs: How many runs.
    """

    label: str
    scenario: Scenario
    robots: int
    runs: int

    @property
    def key(self) -> tuple[str, str, int]:
        """What tells it from the other cells of a table."""
        return self.label, self.scenario.profile, self.robots

    @property
    def name(self) -> str:
        """How people tell it from the others."""
        return f"{self.label}, {self.robots} robots, {self.scenario.profile}"


class Grid:
    """The cells of a table, measured one after another; what an earlier command left in the file is not run again.

    The file also keeps the cells that are not asked for now, until a cell of the same key with other settings is done.

    Attributes:
        cells: All cells that were asked for and can be run, in their order.
        skipped: Labels whose controller cannot be made, with the reason.
    """

    def __init__(self, path: Path, cells: Sequence[RunCell], seed: int) -> None:
        """Find out what is to be run.

        Args:
            path: Parquet file with one row per run.
            cells: What is asked for.
            seed: A run is a function of scenario, team size, seed and index alone.

        Raises:
            TriformError: Nothing can be run, the weights of a policy are damaged, a start has no place, or the file
                holds something else.
        """
        self._path, self._seed = path, seed
        self._portables: dict[Scenario, PicklableController] = {}
        self._settings: dict[RunCell, dict[str, Any]] = {}
        self._digests: dict[RunCell, str] = {}
        self._kept, self._tables = _read_tables(path)
        self.cells: list[RunCell] = []
        self.skipped: dict[str, str] = {}
        for cell in cells:
            try:
                self._portable(cell)
            except ConfigurationError as error:
                self.skipped.setdefault(cell.label, str(error))
        for cell in cells:
            if cell.label not in self.skipped:
                self._take(cell)
        if not self.cells:
            raise TriformError(f"nothing to run: {'; '.join(dict.fromkeys(self.skipped.values()))}")

    @property
    def labels(self) -> list[str]:
        """Labels of the cells, in their order."""
        return list(dict.fromkeys(cell.label for cell in self.cells))

    @property
    def waiting(self) -> list[RunCell]:
        """The cells that are not done; of several with equal settings, the first."""
        waiting: dict[str, RunCell] = {}
        for cell in self.cells:
            if not self.is_done(cell):
                waiting.setdefault(self._digests[cell], cell)
        return list(waiting.values())

    def is_done(self, cell: RunCell) -> bool:
        """Tell whether a cell is done."""
        return self._digests[cell] in self._tables

    def controller(self, cell: RunCell) -> Controller[PrivilegedView]:
        """Return the controller of a cell."""
        return self._portables[cell.scenario].controller

    def table(self, cell: RunCell) -> RunTable:
        """Return one row per run of a cell that is done."""
        return self._tables[self._digests[cell]]

    def measure(self, engine: Engine, on_step: Report | None = None) -> Iterator[RunCell]:
        """Run all cells that wait, and yield each when it is done and in the file.

        Args:
            engine: Where to run.
            on_step: Called with the number of robots times control periods that were just done.
        """
        for cell in self.waiting:
            chunk = Chunk(np.arange(cell.runs), cell.scenario.draw_starts(cell.robots, cell.runs, self._seed))
            task = MeasureRuns(cell.scenario, self._seed, self._portables[cell.scenario])
            ((_, table),) = measure_groups(task, [chunk], engine, on_step)
            self._tables[self._digests[cell]] = table
            self._write()
            yield cell

    def summaries(self) -> list[dict[str, Any]]:
        """Return the measures of every cell that is done, with its settings."""
        return [self._summary(cell) for cell in self.cells if self.is_done(cell)]

    def _portable(self, cell: RunCell) -> PicklableController:
        if cell.scenario not in self._portables:
            self._portables[cell.scenario] = PicklableController(cell.scenario)
        return self._portables[cell.scenario]

    def _take(self, cell: RunCell) -> None:
        scenario = cell.scenario
        settings = describe_runs(scenario, self.controller(cell), cell.robots, cell.runs, self._seed)
        self._settings[cell], self._digests[cell] = settings, digest(settings)
        if not self.is_done(cell):
            # What a run would stumble over after hours.
            control_steps(scenario.duration, scenario.robot.control_period)
            if scenario.arena != "open":
                scenario.check_starts(scenario.draw_starts(cell.robots, cell.runs, self._seed))
        self.cells.append(cell)

    def _write(self) -> None:
        """Write one row per run of everything that is done now or was kept."""
        self._kept |= {cell.key: self._digests[cell] for cell in self.cells if self.is_done(cell)}
        tables = []
        for key, settings in self._kept.items():
            table = self._tables[settings]
            values = zip(_KEYS, (*key, settings), strict=True)
            tables.append({name: np.full(len(table["run"]), value) for name, value in values} | table)
        write_parquet(self._path, concatenate(tables))

    def _summary(self, cell: RunCell) -> dict[str, Any]:
        table = self.table(cell)
        return {
            "label": cell.label,
            "profile": cell.scenario.profile,
            "robots": cell.robots,
            **summarise(table),
            **intervals(table),
            "collisions": int(table["collision"].sum()),
            "settings": self._settings[cell],
        }


def describe_runs(
    scenario: Scenario, controller: Controller[PrivilegedView], robots: int, runs: int, seed: int
) -> dict[str, Any]:
    """Return all that decides about runs as plain JSON values, equal for runs that are the same."""
    described = describe(scenario, controller)
    chosen = ("controller_description", "profile_description", "arena", "distance", "duration")
    settings: dict[str, Any] = {name: described[name] for name in chosen}
    settings |= {"robots": robots, "runs": runs, "seed": seed, "triform": __version__}
    if scenario.team != "world":
        settings |= {"team": scenario.team, "drive": scenario.drive}
    described_plainly: dict[str, Any] = plain(settings)
    return described_plainly


def digest(settings: dict[str, Any]) -> str:
    """Return a short name of plain JSON values, which other values do not have."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def intervals(table: RunTable) -> dict[str, tuple[float, float]]:
    """Return Wilson's 95 % intervals of the strict and the success rate of some runs."""
    return {
        f"{measure}_interval": wilson_interval(int(table[measure].sum()), len(table["run"]))
        for measure in ("strict", "success")
    }


def _read_tables(path: Path) -> tuple[dict[tuple[str, str, int], str], dict[str, RunTable]]:
    """Return the digest of settings of every cell of a file, by its key, and one row per run, by the digest."""
    if not path.exists():
        return {}, {}
    rows = read_parquet(path)
    if any(key not in rows for key in _KEYS):
        raise TriformError(f"{path} was not written by this command; remove it or choose another output folder")
    kept: dict[tuple[str, str, int], str] = {}
    tables: dict[str, RunTable] = {}
    for label, profile, team, settings in dict.fromkeys(zip(*(rows[key] for key in _KEYS), strict=True)):
        own = (rows["label"] == label) & (rows["profile"] == profile) & (rows["team"] == team)
        kept[label, profile, int(team)] = settings
        tables[settings] = {name: column[own] for name, column in rows.items() if name not in _KEYS}
    return kept, tables


def measure_waiting(measured: Grid, engine: Engine, console: Console, on_cell: Callable[[float], None]) -> None:
    """Run all cells that wait, with progress.

    Args:
        measured: The cells.
        engine: Where to run.
        console: Where to show progress; a line tells of every cell that is done where no bar can be drawn.
        on_cell: Called with the seconds spent so far when a cell is done, and once more when all are.
    """
    for label, reason in measured.skipped.items():
        console.print(f"left out: {label}: {reason}", markup=False, soft_wrap=True)
    began = time.perf_counter()
    total = sum(cell.scenario.steps * cell.runs * cell.robots for cell in measured.waiting)
    with progress_bar(console, "measuring", total) as advance:
        for cell in measured.measure(engine, advance):
            spent = time.perf_counter() - began
            on_cell(spent)
            if not console.is_terminal:
                console.print(f"done after {spent:.1f} s: {cell.name}", soft_wrap=True)
    on_cell(time.perf_counter() - began)


def spread_out(
    summaries: Sequence[dict[str, Any]], label: str, columns: Sequence[tuple[str, int]], key: str, kind: str
) -> list[str]:
    """Return one measure of a row, formatted, for every column (profile, robots); a dash for what is not done."""
    own = {(each["profile"], each["robots"]): each[key] for each in summaries if each["label"] == label}
    return [format_value(own.get(column), kind) for column in columns]
