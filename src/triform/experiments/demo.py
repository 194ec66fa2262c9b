"""The whole method in one command: nine robots, a policy, a table, pictures, an animation and a page."""

from __future__ import annotations

import importlib.util
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from triform.control import POLICY, ControllerSpec
from triform.evaluation.metrics import RunTable, summarise
from triform.evaluation.rollout import Trajectory
from triform.evaluation.scenario import Scenario
from triform.experiments.settings import check_teams, describe, flat, run_memory, team_sizes
from triform.figures.animation import animate
from triform.figures.runs import Scene, run_figure
from triform.figures.sight import sight_figure
from triform.figures.style import save_figure
from triform.limits import LARGEST_INDEX, check_threads, require_at_most, require_memory
from triform.recordings.description import RunSetting
from triform.recordings.kept import check_kept, keep_runs
from triform.report.listener import SILENT, Listener
from triform.report.output import own_folder, write_json
from triform.report.tables import WIDE, legend, summary_rows
from triform.threads import limit_threads
from triform.types import convert_fields, require

_FASTEST = 1000.0


@dataclass(frozen=True)
class DemoConfig:
    """A demonstration of one team.

    Attributes:
        controller: Controller: a name such as policy, policy:paper or triangulating, or a class of your own as
            FILE.py:CLASS or MODULE:CLASS.
        robots: Number of robots.
        seed: The start is a function of team size, seed and index alone.
        index: Which start: run ``index`` of an evaluation with the same team size and seed.
        output: Folder for the pictures, the animation, the measures, the poses and commands that triform measure reads,
            with the extra video the animation as MP4 and, with the extra view, a page that plays the run.
        mcap: File for what happened in MCAP with Foxglove's schemas, for viewers.
        speed: How many times faster than real the animation runs.
        scans: Whether what happened says what the robots sensed, too: scans, odometry and exploration noise.
        threads: Threads of the whole command; one for each processor if omitted.
        scenario: Everything else about the run.
    """

    controller: ControllerSpec = POLICY
    robots: int = 9
    seed: int = 7
    index: int = 0
    output: Path = Path("demo")
    mcap: Path | None = None
    speed: float = 4.0
    scans: bool = False
    threads: int | None = None
    scenario: Scenario = field(default_factory=Scenario)

    def __post_init__(self) -> None:
        convert_fields(self)
        (robots,) = team_sizes(self.scenario, (self.robots,), (DemoConfig.robots,))
        object.__setattr__(self, "robots", robots)
        check_teams((self.robots,), 1, self.seed)
        require(self.index >= 0, f"index is {self.index}; it must not be negative")
        require_at_most("index", self.index, LARGEST_INDEX)
        require(0 < self.speed <= _FASTEST, f"speed is {self.speed}; it must be positive and at most {_FASTEST:g}")
        check_threads(self.threads)
        check_kept(None, self.mcap)


@dataclass(frozen=True, eq=False)
class DemoRun:
    """One team that was driven.

    Attributes:
        config: What was asked for.
        trajectory: The run, B = 1.
        measures: Its measures, one row.
        settings: Settings and controller, plain JSON values.
        seconds: How long it took [s].
    """

    config: DemoConfig
    trajectory: Trajectory
    measures: RunTable
    settings: dict[str, Any]
    seconds: float

    @property
    def scene(self) -> Scene:
        """What surrounds the run in drawings."""
        scenario = self.config.scenario
        outlines = scenario.team.outlines(self.trajectory.poses.shape[2])
        return Scene(outlines, scenario.surroundings, scenario.distance, scenario.event)

    def draw(self, path: Path) -> list[Path]:
        """Write the run as a picture, ``.png``, and beside it as vectors, and return the files."""
        title = f"{self.config.robots} robots, controller {self.config.controller.label}"
        return save_figure(run_figure(self.trajectory, self.scene, title), path)

    def draw_sight(self, path: Path) -> list[Path]:
        """Write what one robot sees as a picture, ``.png``, and beside it as vectors, and return the files."""
        config = self.config
        figure = sight_figure(self.trajectory, self.scene, config.scenario.team, config.controller)
        return save_figure(figure, path)

    def animate(self, gif: Path, video: Path | None = None) -> list[Path]:
        """Write the run as a moving picture and return the files.

        Raises:
            ModuleNotFoundError: PyAV is not installed, and a video is wanted.
        """
        config = self.config
        return animate(
            self.trajectory,
            self.scene,
            config.scenario.team,
            gif,
            controller=config.controller,
            video=video,
            speed=config.speed,
        )


def drive_team(config: DemoConfig, listener: Listener = SILENT) -> DemoRun:
    """Drive the team of a demonstration.

    Raises:
        TriformError: A name in the configuration is unknown, or the controller or the simulator fails.
    """
    scenario = config.scenario
    controller = scenario.make_controller(config.controller)
    poses = scenario.sample_starts(config.robots, 1, config.seed, first=config.index)
    bar = listener.progress(f"{config.robots} robots, {scenario.duration:g} s", scenario.steps * config.robots)
    with limit_threads(config.threads), bar as advance:
        scenario.warm_up(poses, controller)
        began = time.perf_counter()
        trajectory, table = scenario.run(poses, controller, config.seed, [config.index], advance, config.scans)
    took = time.perf_counter() - began
    settings = flat(config, without=("output", "mcap", "speed", "scans", "threads")) | describe(scenario, controller)
    return DemoRun(config, trajectory, table, settings, took)


def run_demo(config: DemoConfig, listener: Listener = SILENT) -> list[Path]:
    """Run one team, show its measures and write pictures, an animation, the measures and what happened.

    Where PyAV is installed, the animation is an MP4 too; where viser is, a page plays the run.

    Args:
        config: What to run and where to put the files.
        listener: Hears of progress, tables and files.

    Returns:
        The files written: PNG, PDF, GIF, perhaps MP4, JSON, perhaps HTML, and Parquet.

    Raises:
        TriformError: The folder cannot be written, or a name in the configuration is unknown.
    """
    scenario, label = config.scenario, config.controller.label
    # Figures hold the graphs of all records.
    graphs = 2.0 * scenario.steps * config.robots**2
    needed = run_memory(scenario, config.robots, scans=config.scans) + graphs
    require_memory(needed, f"a run of {config.robots} robots")
    kept = [path for path in (config.output / "run.parquet", config.mcap) if path is not None]
    with own_folder(config.output), keep_runs(*kept) as writer:
        run = drive_team(config, listener)
        result = {"robots": config.robots, **summarise(run.measures)}
        headings, rows = summary_rows([result], WIDE)
        title = f"{label}: {scenario.duration:g} s simulated in {run.seconds:.1f} s"
        listener.table(title, headings, rows, legend(headings))
        if config.robots < 3:
            listener.say("a team of one or two robots has no triangle, so it can be a success but never strict")
        with listener.progress("drawing", 1):
            video = config.output / "demo.mp4" if importlib.util.find_spec("av") else None
            values = {"config": run.settings, "wall_seconds": run.seconds, "results": [result]}
            paths = [
                *run.draw(config.output / "demo.png"),
                *run.draw_sight(config.output / "sight.png"),
                *run.animate(config.output / "demo.gif", video),
                write_json(config.output / "demo.json", values),
            ]
            if importlib.util.find_spec("viser"):
                from triform.viewer.offline import write_page

                page = config.output / "demo.html"
                paths.append(write_page(run.trajectory, run.scene, page, scenario.team.profiles))
            writer.describe(run.settings)
        setting = RunSetting.of(scenario, run.trajectory.poses.shape[2])
        writer.add(run.trajectory, setting, {"run": np.array([config.index]), **run.measures})
    for path in [*paths, *kept]:
        listener.say(f"wrote {path}")
    return [*paths, *kept]
