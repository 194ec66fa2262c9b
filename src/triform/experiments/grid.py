"""A grid: cells of runs, measured once, kept in a file, and resumed from it."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from triform.control import ControllerSpec
from triform.engines import Engine, Report
from triform.evaluation.metrics import RunTable, concatenate, summarise
from triform.evaluation.rollout import Trajectory
from triform.evaluation.runs import Execution, by_group, chunks
from triform.experiments.cell import Cell
from triform.experiments.settings import digest, flat, warn_of_time
from triform.geometry.cells import SMALL_TEAM
from triform.report.listener import SILENT, Listener
from triform.report.output import own_folder, write_json
from triform.report.tables import format_measure, read_parquet, require_parquet, write_parquet
from triform.simulation import sample_starts
from triform.threads import limit_threads
from triform.types import ConfigurationError, Controller, TriformError

#: Keeps what happened in some runs of a cell, and their measures.
Keep = Callable[[Cell, Trajectory, RunTable], None]

#: Columns of the table of runs behind the labels: team size at the start, and digest of all settings.
_KEYS = ("team", "settings")


@dataclass(frozen=True)
class _Chunk:
    """Some runs of a cell: its number, its first run and how many."""

    cell: int
    first: int
    count: int


@dataclass(frozen=True)
class _MeasureChunks:
    """The task of a grid: drive the runs of a chunk and measure them.

    Attributes:
        cells: The cells by number.
        controllers: Controller of every cell, by number.
        kept: Whether trajectories are wanted; they are dropped otherwise.
    """

    cells: Mapping[int, Cell]
    controllers: Mapping[int, Controller[Any]]
    kept: bool = False

    def __call__(self, chunk: _Chunk, report: Report) -> tuple[RunTable, Trajectory | None]:
        """One row per run, and what happened; reports robots times control periods."""
        cell = self.cells[chunk.cell]
        trajectory, table = cell.run(chunk.first, chunk.count, self.controllers[chunk.cell], report)
        return table, trajectory if self.kept else None


class _InOrder:
    """Keeps chunks that are finished in any order in the order in which they were begun, whatever the engine."""

    def __init__(self, chunks: Sequence[_Chunk], cells: Mapping[int, Cell], keep: Keep) -> None:
        """Take all chunks, in their order."""
        self._chunks, self._cells, self._keep = chunks, cells, keep
        self._waiting: dict[int, tuple[RunTable, Trajectory]] = {}
        self._next = 0

    def add(self, index: int, table: RunTable, trajectory: Trajectory) -> None:
        """Keep a chunk, or hold it until those before it are kept."""
        self._waiting[index] = table, trajectory
        while self._next in self._waiting:
            table, trajectory = self._waiting.pop(self._next)
            self._keep(self._cells[self._chunks[self._next].cell], trajectory, table)
            self._next += 1


class Grid:
    """Cells, measured on an engine; what an earlier command left in the file is not run again.

    The file also keeps cells that are not asked for now, until a cell of the same key with other settings is done.

    Attributes:
        cells: All cells that can be run or shown, in their order.
        skipped: Names of groups that cannot be run, with the reason.
    """

    def __init__(self, cells: Sequence[Cell], path: Path | None = None) -> None:
        """Find out what is to be run.

        Args:
            cells: What is asked for; all have the same label columns.
            path: Parquet file with one row per run; nothing is kept if ``None``.

        Raises:
            TriformError: Nothing can be run, the weights of a policy are damaged, or the file holds something else.
        """
        self._path = path
        self._columns = tuple(cells[0].labels) if cells else ()
        self._kept, self._tables = _read_tables(path, self._columns)
        self._controllers: dict[Any, Controller[Any]] = {}
        self._settings: dict[Cell, dict[str, Any]] = {}
        self._digests: dict[Cell, str] = {}
        self.cells: list[Cell] = []
        self.skipped: dict[str, str] = {}
        for cell in cells:
            try:
                self._take(cell)
            except ConfigurationError as error:
                if cell.wanted:
                    self.skipped.setdefault(cell.group, str(error))
        self.cells = [cell for cell in self.cells if cell.group not in self.skipped]
        if not any(cell.wanted for cell in self.cells):
            raise TriformError(f"nothing to run: {'; '.join(dict.fromkeys(self.skipped.values()))}")

    @property
    def waiting(self) -> list[Cell]:
        """The cells that are wanted and not done; of several with equal settings, the first."""
        waiting: dict[str, Cell] = {}
        for cell in self.cells:
            if cell.wanted and not self.is_done(cell):
                waiting.setdefault(self._digests[cell], cell)
        return list(waiting.values())

    @property
    def done(self) -> list[Cell]:
        """The cells that are done, in their order."""
        return [cell for cell in self.cells if self.is_done(cell)]

    def is_done(self, cell: Cell) -> bool:
        """Tell whether a cell is done."""
        return self._digests[cell] in self._tables

    def controller(self, cell: Cell) -> Controller[Any]:
        """Return the controller of a cell, with the guard of its scenario."""
        return self._controllers[_kind(cell)]

    def digest(self, cell: Cell) -> str:
        """Return a short name of all that decides about the runs of a cell."""
        return self._digests[cell]

    def table(self, cell: Cell) -> RunTable:
        """Return one row per run of a cell that is done."""
        return self._tables[self._digests[cell]]

    def measure(self, engine: Engine, on_step: Report | None = None, keep: Keep | None = None) -> Iterator[Cell]:
        """Run all cells that wait, and yield each when it is done and in the file.

        Args:
            engine: Where to run.
            on_step: Called with the number of robots times control periods that were just done.
            keep: Called with what happened, in the order of cells and runs.
        """
        waiting = dict(enumerate(self.waiting))
        controllers = {number: self.controller(cell) for number, cell in waiting.items()}
        task = _MeasureChunks(waiting, controllers, keep is not None)
        parts = [
            [_Chunk(number, part.start, part.stop - part.start) for part in chunks(cell.runs, cell.robots)]
            for number, cell in waiting.items()
        ]
        ordered = None if keep is None else _InOrder([chunk for part in parts for chunk in part], waiting, keep)

        def take(index: int, result: tuple[RunTable, Trajectory | None]) -> RunTable:
            table, trajectory = result
            if ordered is not None and trajectory is not None:
                ordered.add(index, table, trajectory)
            return table

        for number, tables in by_group(task, parts, engine, take, on_step):
            self._tables[self._digests[waiting[number]]] = concatenate(tables)
            self._write()
            yield waiting[number]

    def warm_up(self) -> None:
        """Compile the kernels that the cells need, each kind of controller with a small and a large team."""
        kinds = {(_kind(cell), cell.robots > SMALL_TEAM): cell for cell in self.waiting}
        for cell in kinds.values():
            robots = cell.scenario.team.team_size(None, min(cell.robots, SMALL_TEAM + 1))
            poses = sample_starts(robots, 1, cell.seed, distance=cell.scenario.distance)
            cell.scenario.warm_up(poses, self.controller(cell))

    def summaries(self) -> list[dict[str, Any]]:
        """Return the labels, measures and settings of every cell that is done."""
        return [self._summary(cell) for cell in self.done]

    def _take(self, cell: Cell) -> None:
        kind = _kind(cell)
        if kind not in self._controllers:
            self._controllers[kind] = cell.scenario.make_controller(cell.controller)
        self._settings[cell] = cell.settings(self._controllers[kind])
        self._digests[cell] = digest(self._settings[cell])
        if cell.wanted and not self.is_done(cell):
            cell.check()
        self.cells.append(cell)

    def _write(self) -> None:
        """Write one row per run of everything that is done now or was kept, with the columns that all have."""
        if self._path is None:
            return
        # After what was kept, in the order of the cells, whichever was done first.
        kept = self._kept | {cell.key: self._digests[cell] for cell in self.done}
        tables = []
        for key, settings in kept.items():
            table = self._tables[settings]
            values = zip((*self._columns, *_KEYS), (*key, settings), strict=True)
            tables.append({name: np.full(len(table["run"]), value) for name, value in values} | table)
        shared = [name for name in tables[0] if all(name in table for table in tables)]
        write_parquet(self._path, concatenate([{name: table[name] for name in shared} for table in tables]))

    def _summary(self, cell: Cell) -> dict[str, Any]:
        table = self.table(cell)
        return {
            **cell.labels,
            "robots": cell.robots,
            **summarise(table),
            "collisions": int(table["collision"].sum()),
            "arena_hits": int(table["hit_arena"].sum()),
            "settings": self._settings[cell],
        }


def measure_grid(
    grid: Grid,
    execution: Execution,
    on_cell: Callable[[float], None],
    listener: Listener = SILENT,
    engine: Engine | None = None,
    title: str = "measuring",
    keep: Keep | None = None,
) -> None:
    """Run all cells of a grid that wait, with progress.

    Args:
        grid: The cells.
        execution: Where to run.
        on_cell: Called with the seconds spent so far when a cell is done, and once more when all are.
        listener: Hears of progress, of what is left out and of every cell that is done.
        engine: The engine, if it is open already.
        title: What a progress bar says.
        keep: Called with what happened, in the order of cells and runs.

    Raises:
        ConfigurationError: The threads together need more memory than there is.
    """
    for name, reason in grid.skipped.items():
        listener.say(f"left out: {name}: {reason}")
    execution.require_memory(max((cell.memory for cell in grid.waiting), default=0.0))
    warn_of_time(sum(cell.work for cell in grid.waiting), execution.threads, listener)
    grid.warm_up()
    began = time.perf_counter()
    with (
        limit_threads(execution.threads),
        execution.open_engine() if engine is None else nullcontext(engine) as where,
        listener.progress(title, sum(cell.work for cell in grid.waiting)) as advance,
    ):
        for cell in grid.measure(where, advance, keep):
            seconds = time.perf_counter() - began
            on_cell(seconds)
            listener.milestone(f"done after {seconds:.1f} s: {cell.name}")
    on_cell(time.perf_counter() - began)


@contextmanager
def open_grid(folder: Path, name: str, list_cells: Callable[[Path], Sequence[Cell]]) -> Iterator[Grid]:
    """Hold a folder for an experiment alone, and give the grid whose runs it keeps and from which it goes on.

    Args:
        folder: The folder.
        name: Name of the file of runs, without its ending.
        list_cells: Takes the path of that file, and returns the cells.

    Raises:
        TriformError: Another process works in the folder, it cannot be written or holds something else, or nothing can
            be run.
    """
    require_parquet()
    path = folder / f"{name}.parquet"
    with own_folder(folder):
        yield Grid(list_cells(path), path)


def measure_in_folder(
    config: Any,
    name: str,
    grid: Grid,
    listener: Listener,
    more: Callable[[], Mapping[str, Any]],
    without: Collection[str] = ("output",),
    on_summaries: Callable[[list[dict[str, Any]]], object] = len,
) -> list[dict[str, Any]]:
    """Run all cells of a grid that wait; whenever one is done, write the summaries of all that are.

    Args:
        config: Options of the experiment, with ``output`` and ``execution``.
        name: Name of the file, without its ending.
        grid: The cells.
        listener: Hears of progress.
        more: Returns what the file holds besides options and summaries.
        without: Options that say nothing about results.
        on_summaries: Called with the summaries after they are written.

    Returns:
        What ``Grid.summaries`` returns in the end.
    """
    summaries: list[dict[str, Any]] = []

    def keep(seconds: float) -> None:
        summaries[:] = grid.summaries()
        options = {"config": flat(config, without), "wall_seconds": round(seconds, 3)}
        write_json(config.output / f"{name}.json", {**options, **more(), "cells": summaries})
        on_summaries(summaries)

    measure_grid(grid, config.execution, keep, listener)
    return summaries


def read_labels(path: Path, column: str) -> set[str]:
    """Return the labels that a file of a grid holds in one column; none if there is no such file."""
    return {str(label) for label in read_parquet(path).get(column, ())} if path.exists() else set()


def spread_out(
    summaries: Sequence[dict[str, Any]], label: str, columns: Sequence[tuple[str, int]], key: str, kind: str
) -> list[str]:
    """Return one measure of a row, formatted, for every column (profile, robots); a dash for what is not done."""
    own = {(each["profile"], each["robots"]): each for each in summaries if each["label"] == label}
    return [format_measure(own[column], key, kind) if column in own else "-" for column in columns]


def _kind(cell: Cell) -> Any:
    """What a controller is made for: its name or itself, distance, robots, limits of the base, guard."""
    scenario, given = cell.scenario, cell.controller
    who = given if isinstance(given, ControllerSpec) else id(given)
    # ORCA knows the obstacles.
    arena = scenario.arena if scenario.guard == "orca" else ""
    return who, scenario.distance, scenario.team, scenario.driven, scenario.guard, arena


def _read_tables(
    path: Path | None, columns: Sequence[str]
) -> tuple[dict[tuple[str | int, ...], str], dict[str, RunTable]]:
    """Return the digest of settings of every cell of a file, by its key, and one row per run, by the digest."""
    if path is None or not path.exists():
        return {}, {}
    rows = read_parquet(path)
    names = (*columns, *_KEYS)
    if any(name not in rows for name in names):
        raise TriformError(f"{path} was not written by this command; remove it or choose another output folder")
    kept: dict[tuple[str | int, ...], str] = {}
    tables: dict[str, RunTable] = {}
    for values in dict.fromkeys(zip(*(rows[name] for name in names), strict=True)):
        own = np.logical_and.reduce([rows[name] == value for name, value in zip(names, values, strict=True)])
        kept[(*values[:-2], int(values[-2]))] = values[-1]
        tables[values[-1]] = {name: column[own] for name, column in rows.items() if name not in names}
    return kept, tables
