"""A grid: cells of runs, measured once, kept in a file, and resumed from it."""

from __future__ import annotations

import copy
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from triform.control import ControllerSpec, control_steps
from triform.engines import Engine, Report
from triform.evaluation.events import Event
from triform.evaluation.metrics import RunTable, concatenate, summarise, wilson_interval
from triform.evaluation.rollout import Trajectory
from triform.evaluation.runs import Execution, by_group, chunks
from triform.evaluation.scenario import Scenario
from triform.geometry.cells import SMALL_TEAM
from triform.kernels import kernels_were_compiled
from triform.report.listener import SILENT, Listener
from triform.report.output import plain
from triform.report.tables import format_value, read_parquet, write_parquet
from triform.simulation import sample_starts
from triform.threads import limit_threads
from triform.types import ConfigurationError, Controller, FloatArray, IntArray, TriformError
from triform.version import __version__

#: Teams of more robots than this get so many times the duration, for they have farther to go.
LARGE_TEAM = 13
LARGE_TEAM_TIME = 3
#: Columns of the table of runs behind the labels: team size at the start, and digest of all settings.
_KEYS = ("team", "settings")


@dataclass(frozen=True)
class Starts:
    """Explicit starts of one team size.

    Attributes:
        indices: Index of every run, on which its noise depends, shape (B,).
        poses: Starts, shape (B, N, 3) [m, m, rad].
    """

    indices: IntArray
    poses: FloatArray


@dataclass(frozen=True, eq=False)
class Cell:
    """One controller with one team size in one scenario: what is run many times.

    Attributes:
        labels: What tells the cell from others in a table, by column.
        scenario: Everything about a run but its start and controller.
        controller: Who steers: the name of a controller, or a controller.
        robots: Robots at the start.
        runs: Number of runs.
        seed: A run is a function of scenario, team size, seed and index alone.
        name: How people tell the cell from others.
        group: Cells of a group are left out together, if the controller of one of them cannot be made.
        starts: Explicit starts instead of random ones.
        wanted: Whether the cell is to be run; if not, only results that the file holds are shown.
    """

    labels: Mapping[str, str]
    scenario: Scenario
    controller: ControllerSpec | Controller[Any]
    robots: int
    runs: int
    seed: int
    name: str
    group: str = ""
    starts: Starts | None = None
    wanted: bool = True

    @property
    def key(self) -> tuple[str | int, ...]:
        """Values of the labels, and the team size."""
        return (*self.labels.values(), self.robots)

    @property
    def work(self) -> int:
        """Robots times control periods of all runs."""
        return self.scenario.steps * self.runs * self.robots

    def run(
        self, first: int, count: int, controller: Controller[Any], on_step: Report | None = None
    ) -> tuple[Trajectory, RunTable]:
        """Run ``count`` runs from number ``first`` on, all at once; return what happened, and one row per run."""
        if self.starts is None:
            indices = np.arange(first, first + count)
            poses = self.scenario.sample_starts(self.robots, count, self.seed, first)
        else:
            some = slice(first, first + count)
            indices, poses = self.starts.indices[some], self.starts.poses[some]
        trajectory, table = self.scenario.run(poses, controller, self.seed, indices, on_step)
        return trajectory, {"run": indices} | table

    def check(self) -> None:
        """Find out now what a run would stumble over after hours.

        Raises:
            ConfigurationError: A time is no whole number of control periods, or the arena has no place for a start.
        """
        scenario, period = self.scenario, self.scenario.robot.control_period
        control_steps(scenario.duration, period)
        if scenario.event is not None and scenario.event.interrupts:
            control_steps(scenario.event.time, period)
        if self.starts is not None:
            scenario.check_starts(self.starts.poses)
        elif scenario.arena != "open":
            scenario.check_starts(scenario.sample_starts(self.robots, self.runs, self.seed))


@dataclass(frozen=True)
class _Chunk:
    """Some runs of a cell: its number, its first run and how many."""

    cell: int
    first: int
    count: int


@dataclass(frozen=True)
class _MeasureChunks:
    """The task of a grid: drive the runs of a chunk and measure them; the trajectories are dropped.

    Attributes:
        cells: The cells by number.
        controllers: Controller of every cell, by number.
    """

    cells: Mapping[int, Cell]
    controllers: Mapping[int, Controller[Any]]

    def __call__(self, chunk: _Chunk, report: Report) -> RunTable:
        """One row per run; reports robots times control periods."""
        cell = self.cells[chunk.cell]
        return cell.run(chunk.first, chunk.count, self.controllers[chunk.cell], report)[1]


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
                    self.skipped.setdefault(cell.group or cell.name, str(error))
        self.cells = [cell for cell in self.cells if (cell.group or cell.name) not in self.skipped]
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
        """Return the controller of a cell, with the safety filter of its scenario."""
        return self._controllers[_kind(cell)]

    def settings(self, cell: Cell) -> dict[str, Any]:
        """Return all that decides about the runs of a cell, plain JSON values."""
        return self._settings[cell]

    def table(self, cell: Cell) -> RunTable:
        """Return one row per run of a cell that is done."""
        return self._tables[self._digests[cell]]

    def measure(self, engine: Engine, on_step: Report | None = None) -> Iterator[Cell]:
        """Run all cells that wait, and yield each when it is done and in the file.

        Args:
            engine: Where to run.
            on_step: Called with the number of robots times control periods that were just done.
        """
        waiting = dict(enumerate(self.waiting))
        task = _MeasureChunks(waiting, {number: self.controller(cell) for number, cell in waiting.items()})
        parts = [
            [_Chunk(number, part.start, part.stop - part.start) for part in chunks(cell.runs, cell.robots)]
            for number, cell in waiting.items()
        ]
        for number, tables in by_group(task, parts, engine, on_step):
            self._tables[self._digests[waiting[number]]] = concatenate(tables)
            self._write()
            yield waiting[number]

    def warm_up(self) -> None:
        """Compile the kernels that the cells need, each kind of controller with a small and a large team."""
        kinds = {(_kind(cell), cell.robots > SMALL_TEAM): cell for cell in self.waiting}
        for cell in kinds.values():
            robots = min(cell.robots, SMALL_TEAM + 1)
            poses = sample_starts(robots, 1, cell.seed, distance=cell.scenario.distance)
            cell.scenario.warm_up(poses, copy.deepcopy(self.controller(cell)))

    def summaries(self) -> list[dict[str, Any]]:
        """Return the labels, measures, Wilson intervals and settings of every cell that is done."""
        return [self._summary(cell) for cell in self.done]

    def _take(self, cell: Cell) -> None:
        kind = _kind(cell)
        if kind not in self._controllers:
            scenario, given = cell.scenario, cell.controller
            self._controllers[kind] = (
                scenario.make_controller(given) if isinstance(given, ControllerSpec) else scenario.filtered(given)
            )
        self._settings[cell] = describe_runs(cell, self._controllers[kind])
        self._digests[cell] = digest(self._settings[cell])
        if cell.wanted and not self.is_done(cell):
            cell.check()
        self.cells.append(cell)

    def _write(self) -> None:
        """Write one row per run of everything that is done now or was kept, with the columns that all have."""
        if self._path is None:
            return
        self._kept |= {cell.key: self._digests[cell] for cell in self.done}
        tables = []
        for key, settings in self._kept.items():
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
            **intervals(table),
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
) -> float:
    """Run all cells of a grid that wait, with progress.

    Args:
        grid: The cells.
        execution: Where to run.
        on_cell: Called with the seconds spent so far when a cell is done, and once more when all are.
        listener: Hears of progress, of what is left out and of every cell that is done.
        engine: The engine, if it is open already.
        title: What a progress bar says.

    Returns:
        Seconds spent.
    """
    for name, reason in grid.skipped.items():
        listener.say(f"left out: {name}: {reason}")
    if not kernels_were_compiled():
        grid.warm_up()
    began = time.perf_counter()
    with (
        limit_threads(execution.threads),
        execution.open_engine() if engine is None else nullcontext(engine) as where,
        listener.progress(title, sum(cell.work for cell in grid.waiting)) as advance,
    ):
        for cell in grid.measure(where, advance):
            on_cell(time.perf_counter() - began)
            listener.milestone(f"done after {time.perf_counter() - began:.1f} s: {cell.name}")
    on_cell(time.perf_counter() - began)
    return time.perf_counter() - began


def flat(options: Any) -> dict[str, Any]:
    """Return nested options as one flat table of plain values, as the command line spells them.

    A controller becomes ``controller`` and ``weights``, an event its label.
    """
    found: dict[str, Any] = {}
    for each in fields(options):
        value = getattr(options, each.name)
        if isinstance(value, ControllerSpec):
            found |= {"controller": value.name, "weights": value.weights}
        elif isinstance(value, Event):
            found[each.name] = value.label
        elif isinstance(value, Execution):
            continue
        elif is_dataclass(value):
            found |= flat(value)
        elif isinstance(value, tuple):
            found[each.name] = [item.label if isinstance(item, ControllerSpec) else item for item in value]
        else:
            found[each.name] = value
    return found


def describe(scenario: Scenario, controller: Controller[Any]) -> dict[str, Any]:
    """Return a scenario and its controller as plain JSON values, with what their names stand for."""
    return flat(scenario) | {
        "controller_description": controller.description,
        "profile_description": asdict(scenario.robot),
        "triform": __version__,
    }


def describe_runs(cell: Cell, controller: Controller[Any]) -> dict[str, Any]:
    """Return all that decides about the runs of a cell as plain JSON values, equal for cells that run the same."""
    scenario = cell.scenario
    described = describe(scenario, controller)
    chosen = ("controller_description", "profile_description", "arena", "distance", "duration")
    settings: dict[str, Any] = {name: described[name] for name in chosen}
    settings |= {"robots": cell.robots, "runs": cell.runs, "seed": cell.seed, "triform": __version__}
    if scenario.simulator != "builtin":
        settings |= {"team": scenario.simulator, "drive": scenario.base}
    if scenario.event is not None:
        settings |= {"event": asdict(scenario.event)}
    if cell.starts is not None:
        settings |= {"starts": hashlib.sha256(np.ascontiguousarray(cell.starts.poses).tobytes()).hexdigest()}
    plainly: dict[str, Any] = plain(settings)
    return plainly


def digest(settings: dict[str, Any]) -> str:
    """Return a short name of plain JSON values, which other values do not have."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def intervals(table: RunTable) -> dict[str, tuple[float, float]]:
    """Return Wilson's 95 % intervals of the strict and the success rate of some runs."""
    return {
        f"{measure}_interval": wilson_interval(int(table[measure].sum()), len(table["run"]))
        for measure in ("strict", "success")
    }


def read_labels(path: Path, column: str) -> set[str]:
    """Return the labels that a file of a grid holds in one column; none if there is no such file."""
    return {str(label) for label in read_parquet(path).get(column, ())} if path.exists() else set()


def spread_out(
    summaries: Sequence[dict[str, Any]], label: str, columns: Sequence[tuple[str, int]], key: str, kind: str
) -> list[str]:
    """Return one measure of a row, formatted, for every column (profile, robots); a dash for what is not done."""
    own = {(each["profile"], each["robots"]): each[key] for each in summaries if each["label"] == label}
    return [format_value(own.get(column), kind) for column in columns]


def check_teams(robots: Sequence[int], runs: int, seed: int, least: int = 1) -> None:
    """Refuse team sizes, runs and seeds that no experiment has.

    Raises:
        ConfigurationError: There is no team size or one below ``least``, no run, or a negative seed.
    """
    problems = [
        (len(robots) == 0, "robots is empty; at least one team size is needed"),
        *((size < least, f"robots is {size}; a team has at least {least} robot{'s' * (least > 1)}") for size in robots),
        (runs < 1, f"runs is {runs}; at least 1 is needed"),
        (seed < 0, f"seed is {seed}; it must not be negative"),
    ]
    for bad, sentence in problems:
        if bad:
            raise ConfigurationError(sentence)


def _kind(cell: Cell) -> Any:
    """What a controller is made for: its name or itself, distance, robots, limits of the base, filter."""
    scenario, given = cell.scenario, cell.controller
    who = given if isinstance(given, ControllerSpec) else id(given)
    return who, scenario.distance, scenario.robot, scenario.drive_limits, scenario.guard


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
