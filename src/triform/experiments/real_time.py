"""The paper's Fig. 7 and 8 of robots in real time: four emulated ones, each driven by ``triform drive``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from triform.control import ControllerSpec, sight_of, weights_folder
from triform.evaluation import paper
from triform.evaluation.metrics import summarise
from triform.evaluation.scenario import Scenario
from triform.experiments.emulated import EmulatedRun, drive_options, emulated_teams, read_emulated, run_emulated
from triform.experiments.result import Result
from triform.experiments.settings import describe
from triform.figures.maps import figure_7_maps
from triform.figures.runs import Scene, figure_3
from triform.policy import read_spec
from triform.report.listener import Listener
from triform.report.output import plain
from triform.report.tables import LEGEND, summary_rows
from triform.types import ConfigurationError, Controller, PrivilegedView, TriformError

#: How many starts are shown.
STARTS = 2


class NotEmulatedError(TriformError):
    """Robots could not be emulated and driven here; other results need none."""


class RealTimeFigures:
    """Makes Fig. 7 and 8 of the same runs."""

    def __init__(
        self,
        scenario: Scenario,
        spec: ControllerSpec,
        seed: int,
        options: Mapping[str, Any],
        before: Path | None,
        listener: Listener,
    ) -> None:
        """Prepare for the runs, which are made when the first figure needs them.

        Args:
            scenario: The robots' profile, arena, distance, guard and duration; they look as far as their controller.
            spec: Who steers.
            seed: Of the starts.
            options: Options of the command, which the data names.
            before: A file of runs that were kept, which are shown if they were made with the same options.
            listener: Hears of progress.
        """
        self._scenario, self._spec, self._seed = replace(scenario, sight=sight_of(spec)), spec, seed
        self._options, self._before, self._listener = options, before, listener

    @cached_property
    def _controller(self) -> Controller[PrivilegedView]:
        return self._scenario.make_controller(self._spec)

    @cached_property
    def _described(self) -> dict[str, Any]:
        """All that decides about the runs, plain JSON values."""
        described: dict[str, Any] = plain({**self._options, **describe(self._scenario, self._controller)})
        return described

    @cached_property
    def _runs(self) -> list[EmulatedRun] | TriformError:
        """Four emulated robots, driven from every start; or why there are none."""
        before = [] if self._before is None else read_emulated(self._before, self._described)
        if before:
            return before
        try:
            teams = emulated_teams(self._scenario, self._seed, STARTS)
            options = drive_options(self._scenario, self._spec)
            if self._controller.privileged:
                raise ConfigurationError(f"no robot can know what the controller {self._spec.label} needs to know")
            for team in teams:
                self._scenario.check_starts(team.draw_start()[None])
            # Kernels are compiled before robots wait for each other.
            self._scenario.warm_up(teams[0].draw_start()[None], self._controller)
            seconds = self._scenario.duration
            title = f"{paper.REAL_ROBOTS} robots drive in real time"
            with self._listener.progress(title, len(teams) * seconds) as advance:
                return [run_emulated(team, options, seconds, advance) for team in teams]
        except TriformError as error:
            return error

    def figure_7(self) -> Result:
        """Emulated robots over time, and the occupancy maps that they see."""
        text = (
            f"{self._text} Above: where they truly were, with headings, ways so far and the Gabriel graph. "
            "Below, at the same moment: the occupancy map that each robot made of its own scan, in its own frame "
            "(front up), cells and border in the robot's colour; the green circle has the radius d*. The data holds "
            "every scan."
        )

        def draw(runs: Sequence[EmulatedRun], scenes: Sequence[Scene]) -> Figure:
            weights = self._spec.weights if self._spec.name == "policy" else None
            names = [f"start {index}" for index in range(len(runs))]
            return figure_7_maps([run.trajectory for run in runs], scenes, read_spec(weights_folder(weights)), names)

        return self._real_time("Fig. 7: four emulated robots, and what each of them sees", text, draw, scans=True)

    def figure_8(self) -> Result:
        """Distances over trajectories of the emulated robots."""
        text = (
            f"{self._text} Above: distances over time of the pairs that end as Gabriel neighbours; the green "
            "line is the prescribed distance, the band 10 % around it. Below: where every robot started (ring), went "
            "(line) and ended (footprint, white line to the front), and the final graph."
        )

        def draw(runs: Sequence[EmulatedRun], scenes: Sequence[Scene]) -> Figure:
            names = [f"start {index}" for index in range(len(runs))]
            return figure_3([run.trajectory for run in runs], scenes[0], names)

        return self._real_time("Fig. 8: distances and trajectories of four emulated robots", text, draw, scans=False)

    @property
    def _text(self) -> str:
        return (
            f"The first {STARTS} starts of {paper.REAL_ROBOTS} robots with seed {self._seed}, not selected by "
            "outcome. No real robot drove here: RoboMaster EP with LD20 LiDARs are emulated in one world, byte for "
            f"byte, and four processes of triform drive, controller {self._spec.label}, drive them in real time for "
            f"{self._scenario.duration:g} s, each by its own scans alone, at 8 Hz and 0.1 m/s at most. Time counts "
            "from when all of them drive."
        )

    def _real_time(
        self,
        title: str,
        text: str,
        draw: Callable[[Sequence[EmulatedRun], Sequence[Scene]], Figure],
        scans: bool,
    ) -> Result:
        """Draw the emulated robots.

        Raises:
            NotEmulatedError: There are none.
        """
        runs = self._runs
        if isinstance(runs, TriformError):
            raise NotEmulatedError(str(runs)) from runs
        scenes = [Scene(run.setting.footprint, run.setting.arena, run.setting.distance) for run in runs]
        results = [{"robots": paper.REAL_ROBOTS, **summarise(run.measures)} for run in runs]
        headings, rows = summary_rows(results)
        rows = [[f"{row[0]}, start {index}", *row[1:]] for index, row in enumerate(rows)]
        values = {"config": self._described, "results": results}
        kept = runs if scans else [replace(run, trajectory=replace(run.trajectory, senses=())) for run in runs]
        figure = draw(runs, scenes)
        return Result(title, f"{text} {LEGEND}", (headings, rows), {}, values, figure, kept)
