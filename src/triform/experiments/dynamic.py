"""Dynamic teams: a robot comes or goes during the run, and the others have to make the best of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

from triform.engines import Engine, Report
from triform.evaluation.metrics import WINDOW, RunTable, concatenate, measure, quantile, select, summarise
from triform.evaluation.placement import sample_clear_addition
from triform.evaluation.rollout import Trajectory, rollout
from triform.evaluation.runs import PicklableController, by_group
from triform.evaluation.scenario import BulkScenario, chunks, world_seeds
from triform.experiments.evaluate import describe
from triform.report.output import prepare_file, write_json
from triform.report.tables import (
    drop_columns,
    format_value,
    progress_bar,
    require_parquet,
    rich_table,
    write_parquet,
)
from triform.simulation import SimulatedTeam
from triform.threads import limit_threads
from triform.types import Controller, IntArray, PrivilegedView, require

Change = Literal["addition", "removal"]
CHANGES: tuple[Change, ...] = ("addition", "removal")

#: When the paper's team changes [s].
CHANGE_TIME = 21.0

#: The column that a terminal has no room for.
_UNSHOWN = ("sensed",)

#: Keeps the random streams of worlds and of changes apart from those of ``triform evaluate``.
_WORLD_STREAM, _CHANGE_STREAM = 2, 3


@dataclass(frozen=True)
class DynamicConfig(BulkScenario):
    """Settings of the dynamic-team experiment.

    Attributes:
        robots: Team size before the change.
        runs: Runs with an addition, and as many with a removal.
        seed: A run is a function of team size, seed and index alone.
        change_time: When a robot comes or goes [s].
        json: Where to write the summary.
        parquet: Where to write one row per run.
    """

    robots: int = 7
    runs: int = 100
    seed: int = 7
    change_time: float = CHANGE_TIME
    json: Path | None = None
    parquet: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.robots >= 2, f"robots is {self.robots}; a team that changes has at least 2 robots")
        require(self.runs >= 1, f"runs is {self.runs}; at least 1 is needed")
        require(self.seed >= 0, f"seed is {self.seed}; it must not be negative")
        require(
            WINDOW <= self.change_time <= self.duration - WINDOW,
            f"change_time is {self.change_time} s; a run of {self.duration} s is measured over {WINDOW:g} s before the "
            f"change and at its end, so the change must come at least {WINDOW:g} s after the start and before the end",
        )


@dataclass(frozen=True)
class ChangedRuns:
    """Some runs in which a robot comes, or in which one goes.

    Attributes:
        change: Whether a robot comes or goes.
        first: Index of the first run.
        count: How many runs.
    """

    change: Change
    first: int
    count: int


@dataclass(frozen=True)
class MeasureChanges:
    """The task of the dynamic-team experiment.

    Attributes:
        config: What to run.
        portable: Its controller.
    """

    config: DynamicConfig
    portable: PicklableController

    def __call__(self, runs: ChangedRuns, report: Report) -> RunTable:
        """One row per run; reports robots before the change times control periods."""
        return run_changes(self.config, self.portable.controller, runs, report)[1]


def run_changes(
    config: DynamicConfig,
    controller: Controller[PrivilegedView],
    runs: ChangedRuns,
    on_step: Callable[[float], None] | None = None,
) -> tuple[Trajectory, RunTable]:
    """Run teams in which one robot comes or goes at ``change_time``, all at once.

    A robot that comes appears anywhere at least 0.5 d* (and 0.5 m) from everybody and within 2 d* of somebody, clear of
    walls and pillars and in the same room; the one that goes is any, with equal probability.

    Args:
        config: What to run.
        controller: Its controller.
        runs: Which runs; each is a function of team size, seed and index alone.
        on_step: Called with the number of control periods times robots that were just done, for progress.

    Returns:
        The whole trajectories, in which the record of ``change_time`` shows the changed team, and one row of
        measures per run.

    Raises:
        TriformError: The arena has no place for a start or for a robot that joins.
    """
    indices = range(runs.first, runs.first + runs.count)
    poses = config.draw_starts(config.robots, runs.count, config.seed, first=runs.first)
    draws = world_seeds(config.robots, config.seed, indices, _CHANGE_STREAM)

    def act(some: slice, team: SimulatedTeam, step: Callable[[], None] | None) -> tuple[Trajectory, RunTable]:
        before = rollout(team, controller, config.change_time, step)
        changed = change_teams(team, runs.change, draws[some], config.distance)
        after = rollout(team, controller, config.duration - config.change_time, step)
        table = _measure_change(config, before, after, team) | {"changed_robot": changed}
        return before.then(after), table

    seeds = world_seeds(config.robots, config.seed, indices, _WORLD_STREAM)
    trajectory, table = config.run_teams(poses, seeds, act, on_step, spare=1 if runs.change == "addition" else 0)
    return trajectory, table | {"run": np.array(indices), "change": np.array([runs.change] * runs.count)}


def measure_changes(
    config: DynamicConfig,
    controller: Controller[PrivilegedView],
    engine: Engine,
    on_step: Report | None = None,
) -> Iterator[tuple[Change, RunTable]]:
    """Measure all additions and all removals.

    Args:
        config: What to run.
        controller: Its controller.
        engine: Where to run.
        on_step: Called with the number of control periods times robots that were just done, for progress.

    Yields:
        Every change as soon as it is done, and its table: one row of measures per run, in order.

    Raises:
        TriformError: The arena has no place for a start or for a robot that joins; starts are checked before the
            first run.
    """
    config.check_starts(config.draw_starts(config.robots, config.runs, config.seed))
    parts = chunks(config.runs, config.robots)
    groups = [[ChangedRuns(change, part.start, part.stop - part.start) for part in parts] for change in CHANGES]
    task = MeasureChanges(config, PicklableController(config, controller))
    for number, tables in by_group(task, groups, engine, on_step):
        yield CHANGES[number], concatenate(tables)


def change_teams(
    world: SimulatedTeam, change: Change, draws: list[np.random.SeedSequence], distance: float = 1.0
) -> IntArray:
    """Add a robot to, or remove one from, every world with the prescribed ``distance``; return which, shape (B,)."""
    changed = np.empty(len(draws), dtype=np.int64)
    for index, draw in enumerate(draws):
        rng = np.random.default_rng(draw)
        if change == "addition":
            changed[index] = world.add_robot(index, sample_clear_addition(world, index, rng, distance))
        else:
            changed[index] = rng.choice(np.flatnonzero(world.active[index]))
            world.remove_robot(index, int(changed[index]))
    return changed


def _measure_change(config: DynamicConfig, before: Trajectory, after: Trajectory, world: SimulatedTeam) -> RunTable:
    earlier = measure(before, config.distance)
    later = config.measure(after, world)
    return later | {
        "robots_before": earlier["robots"],
        "formed_before": earlier["success"],
        "strict_before": earlier["strict"],
        "recovery_time": later["converge_time"] - config.change_time,
        "strict_recovery_time": later["strict_time"] - config.change_time,
    }


def summarise_changes(table: RunTable) -> dict[str, Any]:
    """Summarise the runs of one kind of change.

    ``recovered`` is the share of runs whose 5 s mean of the formation error is back below 10 % and stays there
    to the end; ``recovered_connected`` is the same share among the runs in which the pairs within sensing range
    still connect everybody right after the change: the others are teams that cannot know of each other. ``strict`` and
    ``strict_connected`` say the same of runs that end in a triangulation.

    Args:
        table: What ``run_changes`` returned.

    Returns:
        Rates as fractions, times in seconds.
    """
    connected = table["connected_start"].astype(np.bool_)
    whole, together = summarise(table), summarise(select(table, connected))
    return {
        "change": str(table["change"][0]),
        "robots_before": int(table["robots_before"][0]),
        "robots_after": int(table["robots"][0]),
        "runs": whole["runs"],
        "formed_before": float(table["formed_before"].mean()),
        "recovered": whole["success"],
        "recovered_sensed": whole["success_sensed"],
        "connected": float(connected.mean()),
        "recovered_connected": together["success"],
        "recovery_time_median": quantile(table["recovery_time"], 0.5),
        "strict_before": float(table["strict_before"].mean()),
        "strict": whole["strict"],
        "strict_connected": together["strict"],
        "strict_recovery_time_median": quantile(table["strict_recovery_time"], 0.5),
        "strict_hold_mean": whole["strict_hold_mean"],
        "settled_speed_median": whole["settled_speed_median"],
        "formation_error_median": whole["formation_error_median"],
        "min_distance": whole["min_distance"],
        "collision": whole["collision"],
    }


def run_dynamic(config: DynamicConfig, console: Console) -> dict[str, Any]:
    """Run additions and removals with a progress bar, keep the results in files and print the table.

    Files are rewritten when all additions and when all removals are done, so an interrupted experiment keeps them.
    Where no bar can be drawn, a line tells of each.

    Args:
        config: What to run and which files to write.
        console: Where to show progress and table.

    Returns:
        What is written as JSON.

    Raises:
        TriformError: A file cannot be written, or a name in the configuration is unknown.
    """
    for path in (config.json, config.parquet):
        if path is not None:
            prepare_file(path)
    if config.parquet is not None:
        require_parquet()
    began = time.perf_counter()
    done: dict[Change, RunTable] = {}
    total = len(CHANGES) * config.steps * config.runs * config.robots
    with (
        limit_threads(config.threads),
        config.open_engine() as engine,
        progress_bar(console, "changing teams", total) as advance,
    ):
        controller = config.make_controller()
        result: dict[str, Any] = {"config": describe(config, controller)}
        for change, changed in measure_changes(config, controller, engine, advance):
            done[change] = changed
            tables = [done[each] for each in CHANGES if each in done]
            result["wall_seconds"] = round(time.perf_counter() - began, 3)
            result["results"] = [summarise_changes(table) for table in tables]
            if config.json is not None:
                write_json(config.json, result)
            if config.parquet is not None:
                write_parquet(config.parquet, concatenate(tables))
            if not console.is_terminal:
                console.print(f"done after {result['wall_seconds']:.1f} s: every {change}", soft_wrap=True)
    shown = drop_columns(*change_rows(result["results"]), _UNSHOWN)
    console.print(rich_table(f"dynamic team, {config.controller}", *shown))
    for path in (config.json, config.parquet):
        if path is not None:
            console.print(f"wrote {path}", soft_wrap=True)
    return result


def change_rows(summaries: list[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return headings and formatted rows of summaries of changes."""
    columns = (
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
    headings = ["change", *(heading for heading, _, _ in columns)]
    rows = [
        [
            f"{summary['robots_before']} → {summary['robots_after']}",
            *(format_value(summary[key], kind) for _, key, kind in columns),
        ]
        for summary in summaries
    ]
    return headings, rows
