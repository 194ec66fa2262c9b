"""Many runs of one controller, measured: the work of ``triform evaluate``."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from triform import __version__
from triform.evaluation.metrics import RunTable, concatenate, select, summarise
from triform.evaluation.output import prepare_file, write_json
from triform.evaluation.scenario import Scenario, batches, world_seeds
from triform.evaluation.tables import progress_bar, require_parquet, rich_table, summary_rows, write_parquet
from triform.simulation import load_starts, starts
from triform.types import Controller, FloatArray, IntArray, PrivilegedView, require


@dataclass(frozen=True)
class EvaluateConfig(Scenario):
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
        tables: One table per team size, one row per run.
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
    on_step: Callable[[float], None] | None = None,
    on_size: Callable[[Evaluation], None] | None = None,
) -> Evaluation:
    """Run and measure every start of every team size.

    Args:
        config: What to run.
        on_step: Called with the number of control periods times robots that were just done, for progress.
        on_size: Called with what was found so far whenever a team size is done.

    Returns:
        Measures of every run.

    Raises:
        TriformError: A name in the configuration is unknown, or the starts or weights cannot be used; all
            starts are checked before the first run.
    """
    began = time.perf_counter()
    controller = config.make_controller()
    evaluation = Evaluation(describe(config, controller))
    groups = start_groups(config)
    for _, poses in groups:
        config.check_starts(poses)
    for indices, poses in groups:
        evaluation.tables.append(evaluate_runs(config, controller, poses, config.seed, on_step, indices))
        evaluation.wall_seconds = time.perf_counter() - began
        if on_size is not None:
            on_size(evaluation)
    return evaluation


def start_groups(config: EvaluateConfig) -> list[tuple[IntArray, FloatArray]]:
    """Return the starts of every team size: indices of the runs (runs,) and poses (runs, N, 3).

    The index of a run from a file is its rank, from 0, among all run numbers of the file, whatever the team sizes.

    Raises:
        TriformError: The file of starts cannot be used, or a team size has no valid start.
    """
    if config.starts is None:
        indices = np.arange(config.runs)
        return [(indices, starts(robots, config.runs, config.seed)) for robots in config.robots]
    given = load_starts(config.starts)
    sizes = np.array([len(poses) for poses in given])
    groups = []
    for robots in np.unique(sizes):
        indices = np.flatnonzero(sizes == robots)
        groups.append((indices, np.stack([given[index] for index in indices])))
    return groups


def evaluate_runs(
    scenario: Scenario,
    controller: Controller[PrivilegedView],
    poses: FloatArray,
    seed: int,
    on_step: Callable[[float], None] | None = None,
    indices: IntArray | None = None,
) -> RunTable:
    """Run and measure the starts ``poses`` (runs, N, 3), as many at once as memory likes.

    Args:
        scenario: What to run.
        controller: Its controller.
        poses: Starts of one team size.
        seed: Seed of the worlds' noise.
        on_step: As in ``evaluate``.
        indices: Index of every run, shape (runs,), on which its noise depends; from 0 by default.

    Returns:
        One row per run, in order.
    """
    runs, robots = poses.shape[:2]
    indices = np.arange(runs) if indices is None else indices
    seeds = world_seeds(robots, seed, indices)
    tables = []
    for batch in batches(runs, robots):
        step = None
        if on_step is not None:
            work = (batch.stop - batch.start) * robots
            step = partial(on_step, work)
        trajectory, world = scenario.run(poses[batch], seeds[batch], controller, step)
        tables.append(scenario.measure(trajectory, world))
    return {"run": indices} | concatenate(tables)


def describe(scenario: Scenario, controller: Controller[PrivilegedView]) -> dict[str, Any]:
    """Return the settings of a scenario as plain JSON values, with what they stand for."""
    settings = {name: value for name, value in asdict(scenario).items() if name not in {"json", "parquet"}}
    return settings | {
        "controller_description": controller.description,
        "profile_description": asdict(scenario.robot),
        "triform": __version__,
    }


def run_evaluation(config: EvaluateConfig, console: Console) -> Evaluation:
    """Evaluate with a progress bar, keep the results in files and print the table.

    Files are rewritten whenever a team size is done, so an interrupted evaluation keeps the finished sizes.

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

    total = config.steps * sum(poses.shape[0] * poses.shape[1] for _, poses in start_groups(config))
    with progress_bar(console, "evaluating", total) as advance:
        evaluation = evaluate(config, advance, keep)
    print_evaluation(evaluation, console)
    for path in (config.json, per_run_file):
        if path is not None:
            console.print(f"wrote {path}", soft_wrap=True)
    return evaluation


def print_evaluation(evaluation: Evaluation, console: Console) -> None:
    """Print the table of measures, and that of disconnected starts if there are any."""
    name = evaluation.config["controller"]
    console.print(rich_table(f"{name}, {evaluation.wall_seconds:.1f} s", *summary_rows(evaluation.results)))
    if evaluation.disconnected_starts:
        rows = summary_rows(evaluation.disconnected_starts)
        console.print(rich_table(f"{name}, starts whose sensing graph is not connected", *rows))
