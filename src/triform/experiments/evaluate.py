"""Many runs of one controller, measured: the work of ``triform evaluate``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from triform.control import POLICY, ControllerSpec
from triform.engines import Engine
from triform.evaluation.metrics import RunTable
from triform.evaluation.rollout import Trajectory
from triform.evaluation.runs import Execution
from triform.evaluation.scenario import Scenario
from triform.experiments.cell import Cell, Starts
from triform.experiments.grid import Grid, Keep, measure_grid
from triform.experiments.settings import check_teams, describe, flat, team_sizes
from triform.recordings.description import RunSetting
from triform.recordings.kept import Writers, check_kept, keep_runs
from triform.report.listener import SILENT, Listener
from triform.report.results import Evaluation, ResultFiles, show_results
from triform.simulation import load_starts
from triform.types import convert_fields, require


@dataclass(frozen=True)
class EvaluateConfig:
    """An evaluation of one controller.

    Attributes:
        controller: Controller: a name such as policy, policy:paper or triangulating, or a class of your own as
            FILE.py:CLASS or MODULE:CLASS.
        robots: Team sizes.
        runs: Runs of each team size.
        seed: A start is a function of team size, seed and index alone.
        starts: File of explicit starts instead (.npy or .csv with columns run, robot, x, y, heading); it then
            decides the team sizes and the number of runs, and runs are counted from 0 in growing order of their
            numbers.
        json: File for the summary.
        parquet: File for one row per run; by default beside the summary.
        keep: File for what happened in every run, in Parquet: poses and commands, as triform measure reads them.
        mcap: File for what happened in the only run, in MCAP with Foxglove's schemas, for viewers.
        scans: Whether these two also hold what the robots sensed: scans, odometry and exploration noise.
        scenario: Everything else about the runs.
        execution: Where the runs are computed.
    """

    controller: ControllerSpec = POLICY
    robots: tuple[int, ...] = (5, 7, 9, 11, 13)
    runs: int = 100
    seed: int = 7
    starts: Path | None = None
    json: Path | None = None
    parquet: Path | None = None
    keep: Path | None = None
    mcap: Path | None = None
    scans: bool = False
    scenario: Scenario = field(default_factory=Scenario)
    execution: Execution = field(default_factory=Execution)

    def __post_init__(self) -> None:
        convert_fields(self)
        object.__setattr__(self, "robots", team_sizes(self.scenario, self.robots, EvaluateConfig.robots))
        check_teams(self.robots, self.runs, self.seed)
        check_kept(self.keep, self.mcap, self.scans)
        require(
            self.mcap is None or (self.runs == 1 and len(self.robots) == 1),
            f"mcap is given with {self.runs} runs of {len(self.robots)} team sizes; it holds one run, because viewers "
            "play one, and triform demo --index shows any of them",
        )

    @property
    def cells(self) -> list[Cell]:
        """One cell per team size.

        The index of a run from a file is its rank, from 0, among all run numbers of the file, whatever the team sizes.

        Raises:
            TriformError: The file of starts cannot be used.
        """
        if self.starts is None:
            return [self._cell(robots, self.runs) for robots in self.robots]
        given = load_starts(self.starts)
        sizes = np.array([len(poses) for poses in given])
        cells = []
        for robots in np.unique(sizes):
            indices = np.flatnonzero(sizes == robots)
            starts = Starts(indices, np.stack([given[index] for index in indices]))
            cells.append(self._cell(int(robots), len(indices), starts))
        return cells

    def _cell(self, robots: int, runs: int, starts: Starts | None = None) -> Cell:
        name, labels = f"teams of {robots}", {"controller": self.controller.label}
        scenario, who, scans = self.scenario, self.controller, self.scans
        return Cell(labels, scenario, who, robots, runs, self.seed, name, "controller", starts, scans=scans)


def evaluate(
    config: EvaluateConfig,
    listener: Listener = SILENT,
    on_size: Callable[[Evaluation], None] | None = None,
    engine: Engine | None = None,
    keep: Keep | None = None,
) -> Evaluation:
    """Run and measure every start of every team size.

    Args:
        config: What to run.
        listener: Hears of progress.
        on_size: Called with what was found so far whenever a team size is done.
        engine: Where to run; what ``config`` names if omitted.
        keep: Called with what happened, in the order of cells and runs.

    Returns:
        Measures of every run; the same to the bit with any engine and any number of threads.

    Raises:
        TriformError: A name in the configuration is unknown, or the starts or weights cannot be used; all
            starts are checked before the first run.
    """
    cells = config.cells
    grid = Grid(cells)
    options = flat(config, without=("json", "parquet", "keep", "mcap", "scans"))
    evaluation = Evaluation(options | describe(config.scenario, grid.controller(grid.cells[0])))

    def on_cell(seconds: float) -> None:
        evaluation.tables = [grid.table(cell) for cell in grid.done]
        evaluation.wall_seconds = seconds
        if on_size is not None:
            on_size(evaluation)

    measure_grid(grid, config.execution, on_cell, listener, engine, "evaluating", keep)
    return evaluation


def run_evaluate(config: EvaluateConfig, listener: Listener = SILENT) -> Evaluation:
    """Evaluate, keep the results in files and show the table.

    Summary and table are rewritten whenever a team size is done, so an interrupted evaluation keeps the finished sizes;
    trajectories are kept when all are.

    Args:
        config: What to run and which files to write.
        listener: Hears of progress, tables and files.

    Returns:
        What was found.

    Raises:
        TriformError: A file cannot be written, which is found out before the first run, or as ``evaluate``.
    """
    files = ResultFiles(config.json, config.parquet)
    kept = [path for path in (config.keep, config.mcap) if path is not None]
    with keep_runs(*kept) as writer:
        evaluation = evaluate(config, listener, files.write, keep=partial(_keep, writer) if kept else None)
        writer.describe(evaluation.config)
    show_results(evaluation, config.controller.label, listener)
    for path in [*files.paths, *kept]:
        listener.say(f"wrote {path}")
    return evaluation


def _keep(writer: Writers, cell: Cell, trajectory: Trajectory, measures: RunTable) -> None:
    writer.add(trajectory, RunSetting.of(cell.scenario, trajectory.poses.shape[2]), measures)
