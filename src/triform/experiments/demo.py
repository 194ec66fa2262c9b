"""The whole method in one command: nine robots, a policy, a table, a picture, an animation and a page."""

from __future__ import annotations

import importlib.util
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from triform.control import POLICY, ControllerSpec
from triform.evaluation.metrics import summarise
from triform.evaluation.scenario import Scenario
from triform.experiments.settings import check_teams, describe, flat, run_memory, team_sizes
from triform.figures.animation import animate
from triform.figures.runs import Scene, run_figure
from triform.figures.style import save_figure
from triform.limits import LARGEST_INDEX, check_threads, require_at_most, require_memory
from triform.recordings.description import RunSetting
from triform.recordings.kept import check_kept, keep_runs
from triform.report.listener import SILENT, Listener
from triform.report.output import own_folder, write_json
from triform.report.tables import WIDE, legend, summary_rows
from triform.threads import limit_threads
from triform.types import convert_fields, require


@dataclass(frozen=True)
class DemoConfig:
    """A demonstration of one team.

    Attributes:
        controller: Controller: a name such as policy, policy:paper or triangulating, or a class of your own as
            FILE.py:CLASS or MODULE:CLASS.
        robots: Number of robots.
        seed: The start is a function of team size, seed and index alone.
        index: Which start: run ``index`` of an evaluation with the same team size and seed.
        output: Folder for the picture, the animation, the measures, the poses and commands that triform measure reads
            and, with the extra view, a page that plays the run.
        mcap: File for what happened in MCAP with Foxglove's schemas, for viewers.
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
        check_threads(self.threads)
        check_kept(None, self.mcap)


def run_demo(config: DemoConfig, listener: Listener = SILENT) -> list[Path]:
    """Run one team, show its measures and write a picture, an animation, the measures and what happened.

    Where viser is installed, it writes a page too, on which the run is played.

    Args:
        config: What to run and where to put the files.
        listener: Hears of progress, tables and files.

    Returns:
        The files written: PNG, GIF, JSON, perhaps HTML, and Parquet.

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
        controller = scenario.make_controller(config.controller)
        poses = scenario.sample_starts(config.robots, 1, config.seed, first=config.index)
        bar = listener.progress(f"{config.robots} robots, {scenario.duration:g} s", scenario.steps * config.robots)
        with limit_threads(config.threads), bar as advance:
            scenario.warm_up(poses, controller)
            began = time.perf_counter()
            trajectory, table = scenario.run(poses, controller, config.seed, [config.index], advance, config.scans)
        took = time.perf_counter() - began
        result = {"robots": config.robots, **summarise(table)}
        headings, rows = summary_rows([result], WIDE)
        title = f"{label}: {scenario.duration:g} s simulated in {took:.1f} s"
        listener.table(title, headings, rows, legend(headings))
        if config.robots < 3:
            listener.say("a team of one or two robots has no triangle, so it can be a success but never strict")

        outlines = scenario.team.outlines(trajectory.poses.shape[2])
        scene = Scene(outlines, scenario.surroundings, scenario.distance)
        with listener.progress("drawing", 1):
            figure = run_figure(trajectory, scene, f"{config.robots} robots, controller {label}")
            settings = flat(config, without=("output", "mcap", "scans", "threads")) | describe(scenario, controller)
            paths = [
                save_figure(figure, config.output / "demo.png"),
                animate(trajectory, scene, config.output / "demo.gif"),
                write_json(
                    config.output / "demo.json", {"config": settings, "wall_seconds": took, "results": [result]}
                ),
            ]
            if importlib.util.find_spec("viser"):
                from triform.viewer.offline import write_page

                paths.append(write_page(trajectory, scene, config.output / "demo.html", scenario.team.profiles))
            writer.describe(settings)
        setting = RunSetting.of(scenario, trajectory.poses.shape[2])
        writer.add(trajectory, setting, {"run": np.array([config.index]), **table})
    for path in [*paths, *kept]:
        listener.say(f"wrote {path}")
    return [*paths, *kept]
