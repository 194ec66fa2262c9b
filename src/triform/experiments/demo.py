"""The whole method in one command: nine robots, a policy, a table, a picture and an animation."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from triform.evaluation.metrics import summarise
from triform.evaluation.scenario import Scenario, world_seeds
from triform.experiments.evaluate import describe
from triform.figures.animation import animate
from triform.figures.runs import Scene, run_figure
from triform.figures.style import save_figure
from triform.report.output import prepare_folder, write_json
from triform.report.tables import WIDE, progress_bar, rich_table, summary_rows
from triform.threads import limit_threads
from triform.types import require


@dataclass(frozen=True)
class DemoConfig(Scenario):
    """Settings of the demonstration.

    Attributes:
        robots: Number of robots.
        seed: The start is a function of team size, seed and index alone.
        index: Which start: run ``index`` of an evaluation with the same team size and seed.
        output: Folder for the picture, the animation and the measures.
    """

    robots: int = 9
    seed: int = 7
    index: int = 0
    output: Path = Path("demo")

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.robots >= 1, f"robots is {self.robots}; a team has at least 1 robot")
        require(self.seed >= 0, f"seed is {self.seed}; it must not be negative")
        require(self.index >= 0, f"index is {self.index}; it must not be negative")


def run_demo(config: DemoConfig, console: Console) -> list[Path]:
    """Run one team, show its measures and write a picture, an animation and the measures.

    Args:
        config: What to run and where to put the files.
        console: Where to show progress, table and paths.

    Returns:
        The files written: PNG, GIF and JSON.

    Raises:
        TriformError: The folder cannot be written, or a name in the configuration is unknown.
    """
    prepare_folder(config.output)
    controller = config.make_controller()
    began = time.perf_counter()
    poses = config.draw_starts(config.robots, 1, config.seed, first=config.index)
    seeds = world_seeds(config.robots, config.seed, [config.index])
    bar = progress_bar(console, f"{config.robots} robots, {config.duration:g} s", config.steps * config.robots)
    with limit_threads(config.threads), bar as advance:
        trajectory, table = config.run(poses, seeds, controller, advance)
    result = {"robots": config.robots, **summarise(table)}
    took = time.perf_counter() - began
    title = f"{config.controller}: {config.duration:g} s simulated in {took:.1f} s"
    console.print(rich_table(title, *summary_rows([result], WIDE)))

    scene = Scene(config.robot.footprint, config.surroundings, config.distance)
    with console.status("drawing"):
        figure = run_figure(trajectory, scene, f"{config.robots} robots, controller {config.controller}")
        paths = [
            save_figure(figure, config.output / "demo.png"),
            animate(trajectory, scene, config.output / "demo.gif"),
            write_json(
                config.output / "demo.json",
                {"config": describe(config, controller), "wall_seconds": took, "results": [result]},
            ),
        ]
    for path in paths:
        console.print(f"wrote {path}", soft_wrap=True)
    return paths
