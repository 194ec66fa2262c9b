"""Many runs of one controller, measured: the work of ``triform evaluate``."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from triform import __version__
from triform.engines import Engine
from triform.evaluation.metrics import RunTable, concatenate, select, summarise
from triform.evaluation.runs import Chunk, MeasureRuns, PicklableController, measure_groups
from triform.evaluation.scenario import BulkScenario, Scenario
from triform.report.output import prepare_file, write_json
from triform.report.tables import WIDE, progress_bar, require_parquet, rich_table, summary_rows, write_parquet
from triform.simulation import load_starts
from triform.threads import limit_threads
from triform.types import Controller, PrivilegedView, require

#: Settings that say nothing about results.
_UNRECORDED = {"json", "parquet", "engine", "ray_address", "threads"}


@dataclass(frozen=True)
class EvaluateConfig(BulkScenario):
    """Settings of an evaluation.

    Attributes:
        robots: Team sizes.
        runs: Runs of each team size.
        seed: A start is a function of team size, seed and index alone.
        starts: File of explicit starts instead (.npy or .csv with columns run, robot, x, y, heading); it then
            decides the team sizes and the number of runs, and runs are counted from 0 in growing order of their
            numbers.
        json: Where to write the summary.
        parquet: Where to write one row per run; by default beside the summary.
    """

    robots: tuple[int, ...] = (5, 7, 9, 11, 13)
    runs: int = 100
    seed: int = 7
    starts: Path | None = None
    json: Path | None = None
    parquet: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require(len(self.robots) > 0, "robots is empty; at least one team size is needed")
        for robots in self.robots:
            require(robots >= 1, f"robots is {robots}; a team has at least 1 robot")
        require(self.runs >= 1, f"runs is {self.runs}; at least 1 is needed")
        require(self.seed >= 0, f"seed is {self.seed}; it must not be negative")

    @property
    def per_run_file(self) -> Path | None:
        """Where one row per run goes; ``None`` if nothing is to be kept."""
        if self.parquet is None and self.json is not None:
            return self.json.with_suffix(".parquet")
        return self.parquet


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
        """One summary per team size, over the runs in which no robot started out of everybody's sight."""
        return [self._summary(table, connected=True) for table in self.tables]

    @property
    def disconnected_starts(self) -> list[dict[str, Any]]:
        """The same over the other runs, whose teams cannot know that they are one; only sizes that have any."""
        return [self._summary(table, connected=False) for table in self.tables if not table["connected_start"].all()]

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


def evaluate(
    config: EvaluateConfig,
    on_progress: Callable[[float], None] | None = None,
    on_size: Callable[[Evaluation], None] | None = None,
    engine: Engine | None = None,
) -> Evaluation:
    """Run and measure every start of every team size.

    Args:
        config: What to run.
        on_progress: Called with the share of all work that was just done.
        on_size: Called with what was found so far whenever a team size is done.
        engine: Where to run; what ``config`` names if omitted.

    Returns:
        Measures of every run; the same to the bit with any engine and any number of threads.

    Raises:
        TriformError: A name in the configuration is unknown, or the starts or weights cannot be used; all
            starts are checked before the first run.
    """
    began = time.perf_counter()
    done: dict[int, RunTable] = {}
    with limit_threads(config.threads):
        controller = config.make_controller()
        evaluation = Evaluation(describe(config, controller))
        groups = start_groups(config)
        for group in groups:
            config.check_starts(group.poses)
        total = config.steps * sum(group.indices.size * group.poses.shape[1] for group in groups)
        task = MeasureRuns(config, config.seed, PicklableController(config, controller))
        share = None if on_progress is None else lambda work: on_progress(work / total)
        with config.open_engine() if engine is None else nullcontext(engine) as where:
            for number, table in measure_groups(task, groups, where, share):
                done[number] = table
                evaluation.tables = [done[each] for each in sorted(done)]
                evaluation.wall_seconds = time.perf_counter() - began
                if on_size is not None:
                    on_size(evaluation)
    return evaluation


def start_groups(config: EvaluateConfig) -> list[Chunk]:
    """Return the runs of every team size.

    The index of a run from a file is its rank, from 0, among all run numbers of the file, whatever the team sizes.

    Raises:
        TriformError: The file of starts cannot be used, or a team size has no valid start.
    """
    if config.starts is None:
        indices = np.arange(config.runs)
        return [Chunk(indices, config.draw_starts(robots, config.runs, config.seed)) for robots in config.robots]
    given = load_starts(config.starts)
    sizes = np.array([len(poses) for poses in given])
    groups = []
    for robots in np.unique(sizes):
        indices = np.flatnonzero(sizes == robots)
        groups.append(Chunk(indices, np.stack([given[index] for index in indices])))
    return groups


def describe(scenario: Scenario, controller: Controller[PrivilegedView]) -> dict[str, Any]:
    """Return the settings of a scenario as plain JSON values, with what they stand for."""
    settings = {name: value for name, value in asdict(scenario).items() if name not in _UNRECORDED}
    return settings | {
        "controller_description": controller.description,
        "profile_description": asdict(scenario.robot),
        "triform": __version__,
    }


def run_evaluation(config: EvaluateConfig, console: Console) -> Evaluation:
    """Evaluate with a progress bar, keep the results in files and print the table.

    Files are rewritten whenever a team size is done, so an interrupted evaluation keeps the finished sizes. Where no
    bar can be drawn, a line tells of every size that is done.

    Args:
        config: What to run and which files to write.
        console: Where to show progress and table.

    Returns:
        What was found.

    Raises:
        TriformError: A file cannot be written, which is found out before the first run, or as ``evaluate``.
    """
    per_run_file = config.per_run_file
    for path in (config.json, per_run_file):
        if path is not None:
            prepare_file(path)
    if per_run_file is not None:
        require_parquet()

    def keep(evaluation: Evaluation) -> None:
        if config.json is not None:
            write_json(config.json, evaluation.as_json())
        if per_run_file is not None:
            write_parquet(per_run_file, evaluation.runs)
        if not console.is_terminal:
            sizes = ", ".join(str(table["robots"][0]) for table in evaluation.tables)
            console.print(f"done after {evaluation.wall_seconds:.1f} s: teams of {sizes}", soft_wrap=True)

    with progress_bar(console, "evaluating", 1.0) as advance:
        evaluation = evaluate(config, advance, keep)
    print_evaluation(evaluation, console)
    for path in (config.json, per_run_file):
        if path is not None:
            console.print(f"wrote {path}", soft_wrap=True)
    return evaluation


def print_evaluation(evaluation: Evaluation, console: Console) -> None:
    """Print the table of measures, and that of disconnected starts if there are any."""
    name = evaluation.config["controller"]
    console.print(rich_table(f"{name}, {evaluation.wall_seconds:.1f} s", *summary_rows(evaluation.results, WIDE)))
    if evaluation.disconnected_starts:
        rows = summary_rows(evaluation.disconnected_starts, WIDE)
        console.print(rich_table(f"{name}, starts whose sensing graph is not connected", *rows))
