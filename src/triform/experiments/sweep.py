"""A controller under many conditions, measured and written: the work of ``triform conditions``."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from triform.control import control_steps
from triform.engines import Engine, Report
from triform.evaluation.incidents import incident_starts, run_incident
from triform.evaluation.metrics import RunTable, concatenate, summarise
from triform.evaluation.rollout import Trajectory
from triform.evaluation.runs import PicklableController, by_group
from triform.evaluation.scenario import chunks, world_seeds
from triform.experiments.condition_page import list_sections
from triform.experiments.conditions import SWEEPS, Cell, Condition, ConditionsConfig, list_cells
from triform.experiments.grid import describe_runs, digest, intervals
from triform.figures.grids import FailedRun, conditions_figure, failures_figure
from triform.figures.runs import Scene
from triform.figures.style import save_figure
from triform.report.output import prepare_folder, write_json
from triform.report.page import write_pages
from triform.report.tables import (
    drop_columns,
    progress_bar,
    read_parquet,
    require_parquet,
    rich_table,
    write_parquet,
)
from triform.simulation import Profile
from triform.threads import limit_threads
from triform.types import BoolArray, ConfigurationError, Controller, PrivilegedView, TriformError

#: Name of all files but the drawing of failed runs.
_NAME = "conditions"
_Kind = tuple[float, Profile]
#: Columns of the table of runs that say which cell a run belongs to.
_KEYS = ("condition", "label", "team", "settings")
#: Columns of the page that a terminal has no room for.
_UNSHOWN = ("interval", "median error", "closest")


@dataclass(frozen=True)
class CellRuns:
    """Some runs of a cell.

    Attributes:
        cell: What is run.
        first: Index of the first run.
        count: How many runs.
    """

    cell: Cell
    first: int
    count: int


def _kind(cell: Cell) -> _Kind:
    """What a controller must be made for: the prescribed distance [m] and the robots."""
    return cell.scenario.distance, cell.scenario.robot


@dataclass(frozen=True)
class MeasureCells:
    """The task of a sweep.

    Attributes:
        config: What all cells have in common.
        portables: The controllers, each for its kind of cells.
    """

    config: ConditionsConfig
    portables: dict[_Kind, PicklableController]

    def __call__(self, runs: CellRuns, report: Report) -> RunTable:
        """One row per run; reports robots at the start times control periods."""
        controller = self.portables[_kind(runs.cell)].controller
        return run_cell(self.config, runs, controller, report)[1]


def run_cell(
    config: ConditionsConfig,
    runs: CellRuns,
    controller: Controller[PrivilegedView],
    on_step: Callable[[float], None] | None = None,
) -> tuple[Trajectory, RunTable]:
    """Run some runs of a cell, all at once.

    Args:
        config: What all cells have in common.
        runs: Which runs; each is a function of the cell, the seed and its index alone.
        controller: The controller for the cell's prescribed distance.
        on_step: Called with the number of robots times control periods that were just done, for progress.

    Returns:
        The whole trajectories, and one row of measures per run.
    """
    cell, indices = runs.cell, range(runs.first, runs.first + runs.count)
    poses = incident_starts(cell.incident, cell.scenario, cell.robots, runs.count, config.seed, runs.first)
    if cell.incident is None:
        seeds = world_seeds(cell.robots, config.seed, indices)
        trajectory, table = cell.scenario.run(poses, seeds, controller, on_step)
    else:
        trajectory, table = run_incident(
            cell.scenario, cell.incident, poses, indices, config.seed, config.incident_time, controller, on_step
        )
    return trajectory, {"run": np.array(indices)} | table


class ConditionSweep:
    """What is to be run, what is done, and what could not be.

    Attributes:
        config: Settings.
        cells: All cells that can be run or shown, in the order in which they are shown.
        skipped: Cells that were asked for and cannot be run, with the reason.
        tables: One row per run of everything that is done, by the digest of its settings.
    """

    def __init__(self, config: ConditionsConfig) -> None:
        """Find out what is to be run, and take over what an earlier sweep left in the folder.

        Raises:
            TriformError: No cell that was asked for can be run, or the folder holds something else.
        """
        self.config = config
        self.controllers: dict[_Kind, Controller[PrivilegedView]] = {}
        self.cells: list[Cell] = []
        self.skipped: dict[str, str] = {}
        self._settings: dict[Cell, dict[str, Any]] = {}
        self._digests: dict[Cell, str] = {}
        self.tables: dict[str, RunTable] = {}
        known, found = _read_tables(config.output / f"{_NAME}.parquet")
        shown = found.union(config.which)
        for cell in list_cells(config):
            if cell.condition not in shown:
                continue
            try:
                self._take(cell, known)
            except ConfigurationError as error:
                if cell.condition in config.which:
                    self.skipped[cell.name] = str(error)
        if not any(cell.condition in config.which for cell in self.cells):
            raise TriformError(f"nothing to run: {'; '.join(dict.fromkeys(self.skipped.values()))}")

    @property
    def waiting(self) -> dict[str, Cell]:
        """One cell for each of the settings that were asked for and are not done, by their digest."""
        waiting: dict[str, Cell] = {}
        for cell in self.cells:
            if cell.condition in self.config.which and self._digests[cell] not in self.tables:
                waiting.setdefault(self._digests[cell], cell)
        return waiting

    @property
    def done(self) -> list[Cell]:
        """The cells that are done."""
        return [cell for cell in self.cells if self._digests[cell] in self.tables]

    def table(self, cell: Cell) -> RunTable:
        """Return one row per run of a cell that is done."""
        return self.tables[self._digests[cell]]

    def measure(self, engine: Engine, on_step: Report | None = None) -> Iterator[Cell]:
        """Run all cells that wait, and yield each when it is done; cells with equal settings are run once.

        Args:
            engine: Where to run.
            on_step: Called with the number of robots times control periods that were just done.
        """
        waiting = self.waiting
        groups = [
            [CellRuns(cell, part.start, part.stop - part.start) for part in chunks(self.config.runs, cell.robots)]
            for cell in waiting.values()
        ]
        portables = {
            _kind(cell): PicklableController(cell.scenario, self.controllers[_kind(cell)]) for cell in waiting.values()
        }
        for number, tables in by_group(MeasureCells(self.config, portables), groups, engine, on_step):
            name, cell = list(waiting.items())[number]
            self.tables[name] = concatenate(tables)
            yield cell

    def summaries(self) -> list[dict[str, Any]]:
        """Return the measures of every cell that is done."""
        return [self._summary(cell) for cell in self.done]

    def write(self, wall_seconds: float) -> None:
        """Write one row per run, and the summaries, of everything that is done."""
        tables = []
        for cell in self.done:
            table = self.table(cell)
            keys = (cell.condition, cell.label, cell.robots, self._digests[cell])
            columns = {name: np.full(len(table["run"]), key) for name, key in zip(_KEYS, keys, strict=True)}
            tables.append(columns | table)
        write_parquet(self.config.output / f"{_NAME}.parquet", concatenate(tables))
        unrecorded = {"output", "engine", "ray_address", "threads", "failures"}
        values = {
            "config": {name: value for name, value in asdict(self.config).items() if name not in unrecorded},
            "wall_seconds": round(wall_seconds, 3),
            "cells": [self._summary(cell) | {"settings": self._settings[cell]} for cell in self.done],
            "skipped": self.skipped,
        }
        write_json(self.config.output / f"{_NAME}.json", values)

    def failed_runs(self) -> list[FailedRun]:
        """Run again the first failed run of as many cells as are to be drawn, those of all conditions in turns."""
        failing: dict[str, tuple[int, Cell, int]] = {}
        ranks = dict.fromkeys(SWEEPS, 0)
        for cell in self.done:
            failed = np.flatnonzero(~formed(self.table(cell)))
            if len(failed) and self._digests[cell] not in failing:
                failing[self._digests[cell]] = (ranks[cell.condition], cell, int(failed[0]))
                ranks[cell.condition] += 1
        drawn = []
        for _, cell, index in sorted(failing.values(), key=lambda entry: entry[0])[: self.config.failures]:
            scenario = cell.scenario
            run = int(self.table(cell)["run"][index])
            trajectory, _ = run_cell(self.config, CellRuns(cell, run, 1), self.controllers[_kind(cell)])
            scene = Scene(scenario.robot.footprint, scenario.surroundings, scenario.distance)
            drawn.append(FailedRun(trajectory, scene, f"{cell.name}, run {run}"))
        return drawn

    def _take(self, cell: Cell, known: dict[str, RunTable]) -> None:
        scenario = cell.scenario
        if _kind(cell) not in self.controllers:
            self.controllers[_kind(cell)] = scenario.make_controller()
        settings = self._describe(cell)
        name = digest(settings)
        if name in known:
            self.tables[name] = known[name]
        elif cell.condition in self.config.which:
            self._check(cell)
        self.cells.append(cell)
        self._settings[cell], self._digests[cell] = settings, name

    def _describe(self, cell: Cell) -> dict[str, Any]:
        """Return all that decides about the runs of a cell as plain JSON values, equal for cells that run the same."""
        controller = self.controllers[_kind(cell)]
        settings = describe_runs(cell.scenario, controller, cell.robots, self.config.runs, self.config.seed)
        settings |= {"incident": cell.incident}
        if cell.incident is not None:
            settings["incident_time"] = self.config.incident_time
        return settings

    def _check(self, cell: Cell) -> None:
        """Find out now what a run would stumble over after hours."""
        period = cell.scenario.robot.control_period
        control_steps(cell.scenario.duration, period)
        if cell.incident is not None:
            control_steps(self.config.incident_time, period)
        if cell.scenario.arena != "open":
            starts = incident_starts(cell.incident, cell.scenario, cell.robots, self.config.runs, self.config.seed)
            cell.scenario.check_starts(starts)

    def _summary(self, cell: Cell) -> dict[str, Any]:
        table = self.table(cell)
        return {
            "condition": cell.condition,
            "label": cell.label,
            "robots": cell.robots,
            **summarise(table),
            **intervals(table),
            "collisions": int(table["collision"].sum()),
            "arena_hits": int(table["hit_arena"].sum()),
        }


def formed(table: RunTable) -> BoolArray:
    """Tell which runs ended as they should: strict, or successful if the team has only two robots."""
    return np.where(table["robots"] > 2, table["strict"], table["success"]).astype(np.bool_)


def run_conditions(config: ConditionsConfig, console: Console) -> list[Path]:
    """Run a controller under all conditions asked for, with progress, and write tables, figures and a page.

    The tables of runs and of summaries are rewritten whenever a cell is done. The same command goes on from there.

    Args:
        config: What to run and where to put it.
        console: Where to show progress and tables.

    Returns:
        The pages written.

    Raises:
        TriformError: The folder cannot be written or holds something else, or nothing can be run.
    """
    prepare_folder(config.output)
    require_parquet()
    began = time.perf_counter()
    with limit_threads(config.threads), config.open_engine() as engine:
        sweep = ConditionSweep(config)
        for name, reason in sweep.skipped.items():
            console.print(f"left out: {name}: {reason}", markup=False, soft_wrap=True)
        waiting = sweep.waiting.values()
        total = sum(cell.scenario.steps * config.runs * cell.robots for cell in waiting)
        with progress_bar(console, "measuring", total) as advance:
            for cell in sweep.measure(engine, advance):
                sweep.write(time.perf_counter() - began)
                if not console.is_terminal:
                    console.print(f"done after {time.perf_counter() - began:.1f} s: {cell.name}", soft_wrap=True)
        sweep.write(time.perf_counter() - began)
        with console.status("drawing"):
            failures = sweep.failed_runs()
            save_figure(conditions_figure(sweep.summaries()), config.output / f"{_NAME}.png")
            if failures:
                save_figure(failures_figure(failures), config.output / "failures.png")
    privileged = next(iter(sweep.controllers.values())).privileged
    sections = list_sections(config, sweep.summaries(), sweep.skipped, len(failures), privileged)
    for section in sections:
        if section.rows:
            console.print(rich_table(section.title, *drop_columns(section.headings, section.rows, _UNSHOWN)))
    pages = write_pages(config.output, "Under many conditions", sections, _NAME)
    names = [*sections[0].files, *(section.image for section in sections if section.image)]
    for path in [*(config.output / name for name in names), *pages]:
        console.print(f"wrote {path}", soft_wrap=True)
    return pages


def _read_tables(path: Path) -> tuple[dict[str, RunTable], set[Condition]]:
    """Return one row per run of every cell of an earlier sweep, by the digest of its settings, and its conditions."""
    if not path.exists():
        return {}, set()
    rows = read_parquet(path)
    if any(key not in rows for key in _KEYS):
        raise TriformError(f"{path} was not written by triform conditions; remove it or choose another output folder")
    tables: dict[str, RunTable] = {}
    for settings in dict.fromkeys(rows["settings"]):
        equal = rows["settings"] == settings
        # Cells with equal settings hold the same runs.
        for key in _KEYS:
            equal &= rows[key] == rows[key][np.argmax(equal)]
        tables[settings] = {name: column[equal] for name, column in rows.items() if name not in _KEYS}
    return tables, set(rows["condition"])
