"""The paper's Table I and Fig. 2 to 5 and 9 with our numbers beside its own, and controllers side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Console

from triform.engines import Engine
from triform.evaluation import paper
from triform.evaluation.metrics import TOLERANCE, WINDOW, RunTable, concatenate, summarise
from triform.evaluation.rollout import Trajectory
from triform.evaluation.scenario import Scenario, world_seeds
from triform.experiments.comparison import Comparison
from triform.experiments.dynamic import (
    CHANGE_TIME,
    CHANGES,
    Change,
    ChangedRuns,
    DynamicConfig,
    change_rows,
    measure_changes,
    run_changes,
    summarise_changes,
)
from triform.experiments.evaluate import EvaluateConfig, Evaluation, describe, evaluate
from triform.experiments.reproduce_config import KEYS, REAL_PROFILE, Contestant, ReproduceConfig, What
from triform.experiments.reproduce_robots import REAL_PUBLISHED, SNAPSHOT_SIZES, Shown, show_real, show_snapshots
from triform.figures.runs import Scene, TeamChange, comparison_figure, figure_3, figure_4, figure_5
from triform.figures.style import save_figure
from triform.report.output import prepare_folder, write_json
from triform.report.page import Section, read_sections, write_markdown, write_pages
from triform.report.tables import (
    LEGEND,
    WIDE,
    Advance,
    drop_columns,
    format_value,
    progress_bar,
    require_parquet,
    rich_table,
    summary_rows,
    write_parquet,
)
from triform.threads import limit_threads
from triform.types import Controller, PrivilegedView

__all__ = ["KEYS", "SIZES", "ReproduceConfig", "What", "reproduce", "trajectory_table"]

SIZES = tuple(paper.SUCCESS)

#: Fig. 5 shows the first of so many runs that qualifies.
_CANDIDATES = 10

_Derived = TypeVar("_Derived", bound=Scenario)


def reproduce(config: ReproduceConfig, console: Console) -> list[Path]:
    """Produce one result, or all, with progress, and the page over everything in the folder.

    Args:
        config: What to produce and where to put it.
        console: Where to show progress and tables.

    Returns:
        The pages written.

    Raises:
        TriformError: The folder cannot be written, or a name in the configuration is unknown.
    """
    prepare_folder(config.output)
    require_parquet()
    pages: list[Path] = []
    with limit_threads(config.threads), config.open_engine() as engine:
        for make in _Reproduction(config, console, engine).makers.values():
            for stage in make():
                section = stage
                # After every stage, so that an interrupted reproduction leaves a page over what is done.
                pages = write_pages(config.output, "Results beside the paper's", read_sections(config.output, KEYS))
            # Controllers have been shown one by one; together they are too wide for many terminals.
            if section.key != "comparison":
                console.print(rich_table(section.title, *drop_columns(section.headings, section.rows, WIDE)))
            for name in [section.image, *section.files]:
                if name:
                    console.print(f"wrote {config.output / name}", soft_wrap=True)
    for page in pages:
        console.print(f"wrote {page}", soft_wrap=True)
    return pages


class _Reproduction:
    """Makes sections; what two of them need is computed once."""

    def __init__(self, config: ReproduceConfig, console: Console, engine: Engine) -> None:
        self.config = config
        self.console = console
        self.engine = engine
        self.scene = Scene(config.robot.footprint, config.surroundings, config.distance)
        self.evaluations: dict[Contestant, Evaluation] = {}
        makers: dict[str, Callable[[], Iterator[Section]]] = {
            "table1": self.table_1,
            "fig2": self.figure_2,
            "fig3": self.figure_3,
            "fig4": self.figure_4,
            "fig5": self.figure_5,
            "fig9": self.figure_9,
            "comparison": self.comparison,
        }
        self.makers = makers if config.what == "all" else {config.what: makers[config.what]}
        # Names and weights that cannot be used are found now, not after hours.
        if config.what != "comparison":
            _ = self.controller
        if "comparison" in self.makers:
            _ = self.compared

    @cached_property
    def controller(self) -> Controller[PrivilegedView]:
        """The controller of everything but the comparison."""
        return self.config.make_controller()

    @cached_property
    def compared(self) -> Comparison:
        """The controllers of the comparison and what it found so far."""
        comparison = Comparison.begin(self.config)
        for label, reason in comparison.skipped.items():
            self.console.print(f"the comparison leaves out {label}: {reason}", markup=False, soft_wrap=True)
        return comparison

    @property
    def evaluation(self) -> Evaluation:
        """All runs of Table I and Fig. 4."""
        return self._evaluate(self.config.own, "evaluating")

    @cached_property
    def real_like(self) -> Evaluation:
        """Runs of four robots like the paper's real ones, for Table I and Fig. 9."""
        changes = {"profile": REAL_PROFILE, "robots": (paper.REAL_ROBOTS,)}
        return self._run(self.config.own, "hardware profile", **changes)

    def table_1(self) -> Iterator[Section]:
        """Success of every team size, and four robots like the paper's real ones."""
        results = self.evaluation.results
        (real,) = self.real_like.results
        headings = [
            "robots", "success paper", "success ours", "sensed ours", "strict ours",
            "error paper", "error ours", "converge paper", "converge ours",
        ]  # fmt: skip
        low, high = (f"{100 * value:.0f}" for value in paper.MEDIAN_ERROR)
        rows = [
            self._row(
                str(result["robots"]),
                format_value(paper.SUCCESS[result["robots"]], "%"),
                f"{low} to {high} %",
                format_value(paper.CONVERGE_TIME, "s"),
                result,
            )
            for result in results
        ]
        rows.append(
            self._row(
                f"{paper.REAL_ROBOTS}*",
                "-",
                format_value(paper.REAL_MEDIAN_ERROR, "%"),
                format_value(paper.REAL_CONVERGE_TIME, "s"),
                real,
            )
        )
        write_parquet(self.config.output / "table1.parquet", self.evaluation.runs)
        section = self._section(
            "table1",
            "Table I: success by team size",
            f"{self.config.runs} random starts per team size, {self.config.duration:g} s each, controller "
            f"{self.config.controller}. The paper gives one range of median errors and one converge time "
            "for all sizes. Row 4* sets the simulated hardware profile beside the paper's runs of "
            "four real robots. Errors and converge times are medians. Sensed counts only pairs within 2 d*; strict is "
            "the share of runs that end in a true triangulation; the paper reports neither.",
            (headings, rows),
        )
        published = {
            "success": paper.SUCCESS,
            "formation_error_median": paper.MEDIAN_ERROR,
            "converge_time_median": paper.CONVERGE_TIME,
            "real_robots": REAL_PUBLISHED,
        }
        self._write(section, self.evaluation.as_json() | {"hardware_profile": real, "paper": published})
        yield section

    def figure_2(self) -> Iterator[Section]:
        """Teams of two sizes at several moments."""
        trajectories, tables = self._first_runs(SNAPSHOT_SIZES)
        shown = show_snapshots(trajectories, tables, self.scene, self.config.seed)
        values = {"config": describe(self.config, self.controller), "results": shown.results}
        yield self._show("fig2", shown, trajectory_table(trajectories), values)

    def figure_3(self) -> Iterator[Section]:
        """Distance histories over trajectories of one run per team size."""
        trajectories, tables = self._first_runs(SIZES)
        save_figure(figure_3(trajectories, self.scene), self.config.output / "fig3.png")
        write_parquet(self.config.output / "fig3.parquet", trajectory_table(trajectories))
        results = [{"robots": int(table["robots"][0]), **summarise(table)} for table in tables]
        headings, rows = summary_rows(results)
        section = self._section(
            "fig3",
            "Fig. 3: distances and trajectories",
            f"The first start of every team size with seed {self.config.seed}, not selected by outcome. Above: "
            "distances over time of the pairs that end as Gabriel neighbours, orange-red if out of "
            "sensing range at the end; the green line is the prescribed distance, the band 10 % around it. Below: "
            "where every robot started (ring), went (line) and ended (footprint, white line to the front), and the "
            f"final graph, dashed where it is longer than robots can sense. {LEGEND}",
            (headings, rows),
            image="fig3.png",
        )
        self._write(section, {"config": describe(self.config, self.controller), "results": results})
        yield section

    def figure_4(self) -> Iterator[Section]:
        """Box plots of formation error and converge time."""
        name = self.config.controller
        save_figure(figure_4(self.evaluation.runs, name), self.config.output / "fig4.png")
        write_parquet(self.config.output / "fig4.parquet", self.evaluation.runs)
        results = self.evaluation.results
        headings, rows = summary_rows(results)
        section = self._section(
            "fig4",
            "Fig. 4: formation error and converge time",
            f"{self.config.runs} runs per team size. Boxes span the quartiles with the median inside, whiskers "
            "reach 1.5 times as far, dots are the runs beyond. Orange-red: the paper's range of median errors, its "
            "median converge time and its success. Runs that never converge have no converge time, so panel b shows "
            f"the n others only. {LEGEND}",
            (headings, rows),
            image="fig4.png",
        )
        self._write(section, self.evaluation.as_json())
        yield section

    def figure_5(self) -> Iterator[Section]:
        """Snapshots of one addition and one removal, and how many of each recover."""
        total = self.config.steps * (_CANDIDATES * (6 + 7) + self.config.runs * (7 + 7))
        with self._progress("changing teams", total) as advance:
            above, which_above = self._shown_change("addition", 6, advance)
            below, which_below = self._shown_change("removal", 7, advance)
            config = self._changing(7, self.config.runs)
            tables = dict(measure_changes(config, self.controller, self.engine, advance))
        save_figure(figure_5([above, below], self.scene), self.config.output / "fig5.png")
        write_parquet(self.config.output / "fig5.parquet", concatenate([tables[change] for change in CHANGES]))
        summaries = [summarise_changes(tables[change]) for change in CHANGES]
        section = self._section(
            "fig5",
            "Fig. 5: a robot comes, a robot goes",
            f"Above, a robot (orange) comes to six at {CHANGE_TIME:g} s; below, one of seven (orange-red) goes. "
            f"Above is {which_above}; below is {which_below}. The table is "
            f"over {self.config.runs} random additions and as many removals to teams of 7. Back: the mean error of "
            f"{WINDOW:g} s is below {100 * TOLERANCE:g} % again within {self.config.duration - CHANGE_TIME:g} s and "
            "stays there; linked: right after the change the pairs within 2 d* still connect everybody; sensed: back, "
            "over pairs within 2 d*; strict: the run ends in a true triangulation; recovery time: median, at least "
            f"{WINDOW:g} s as it is the time of a mean over {WINDOW:g} s.",
            change_rows(summaries),
            image="fig5.png",
        )
        self._write(section, {"config": describe(self.config, self.controller), "results": summaries})
        yield section

    def figure_9(self) -> Iterator[Section]:
        """Box plots of four robots like the paper's real ones."""
        real = self.real_like
        values = real.as_json() | {"paper": REAL_PUBLISHED}
        yield self._show("fig9", show_real(real), real.runs, values)

    def comparison(self) -> Iterator[Section]:
        """Several controllers on the same starts; a section over those that are finished after each of them."""
        compared, folder = self.compared, self.config.output
        for number, contestant in enumerate(list(compared.waiting), start=1):
            label = contestant.label
            evaluation = self._evaluate(contestant, f"{label} ({number} of {number - 1 + len(compared.waiting)})")
            compared.finish(evaluation)
            title = f"{label}, {evaluation.wall_seconds:.1f} s"
            self.console.print(rich_table(title, *summary_rows(evaluation.results, WIDE)))
            save_figure(comparison_figure(compared.results), folder / "comparison.png")
            write_parquet(folder / "comparison.parquet", compared.runs)
            section = self._section(
                "comparison", "Controllers side by side", compared.text, compared.table, image="comparison.png"
            )
            section.files.append("comparison.md")
            write_markdown(folder / "comparison.md", section)
            self._write(section, compared.as_json())
            yield section

    def _evaluate(self, contestant: Contestant, description: str) -> Evaluation:
        """Return all runs of a controller, which are computed once."""
        if contestant not in self.evaluations:
            self.evaluations[contestant] = self._run(contestant, description, robots=SIZES)
        return self.evaluations[contestant]

    def _run(self, contestant: Contestant, description: str, **changes: Any) -> Evaluation:
        """Run and measure a controller on the starts of this reproduction."""
        named = {"controller": contestant.controller, "weights": contestant.weights}
        config = self._derive(EvaluateConfig, runs=self.config.runs, seed=self.config.seed, **named, **changes)
        with self._progress(description, 1.0) as advance:
            return evaluate(config, advance, engine=self.engine)

    def _derive(self, kind: type[_Derived], **changes: Any) -> _Derived:
        """Return a configuration of another kind for the same scenario."""
        shared = {field.name: getattr(self.config, field.name) for field in fields(Scenario)}
        return kind(**(shared | changes))

    def _first_runs(self, sizes: Sequence[int]) -> tuple[list[Trajectory], list[RunTable]]:
        """Run and measure the first start of every team size."""
        trajectories, tables = [], []
        with self._progress("running", self.config.steps * sum(sizes)) as advance:
            for robots in sizes:
                poses = self.config.draw_starts(robots, 1, self.config.seed)
                seeds = world_seeds(robots, self.config.seed, [0])
                trajectory, table = self.config.run(poses, seeds, self.controller, advance)
                trajectories.append(trajectory)
                tables.append(table)
        return trajectories, tables

    def _changing(self, robots: int, runs: int) -> DynamicConfig:
        return self._derive(DynamicConfig, robots=robots, runs=runs, seed=self.config.seed)

    def _shown_change(self, change: Change, robots: int, advance: Advance) -> tuple[TeamChange, str]:
        """Choose the run to show, and say which it is."""
        runs = ChangedRuns(change, 0, _CANDIDATES)
        trajectory, table = run_changes(self._changing(robots, _CANDIDATES), self.controller, runs, advance)
        formed, connected = table["formed_before"], table["connected_start"]
        shown = int(np.argmax(formed & connected))
        wanted = "had formed before the change and whose sensing graph is connected right after it"
        if formed[shown] and connected[shown]:
            which = f"start {shown} of team size {robots}, the first that {wanted}"
        else:
            which = (
                f"start {shown} of team size {robots}, which {'had' if formed[shown] else 'had not'} formed before "
                f"the change and whose sensing graph {'is' if connected[shown] else 'is not'} connected right after "
                f"it: none of the first {_CANDIDATES} starts had formed and stayed connected"
            )
        after = robots + 1 if change == "addition" else robots - 1
        return TeamChange(trajectory.run(shown), CHANGE_TIME, f"{robots} → {after} robots"), which

    def _row(self, robots: str, success: str, error: str, time: str, ours: dict[str, Any]) -> list[str]:
        return [
            robots,
            success,
            format_value(ours["success"], "%"),
            format_value(ours["success_sensed"], "%"),
            format_value(ours["strict"], "%"),
            error,
            format_value(ours["formation_error_median"], "%%"),
            time,
            format_value(ours["converge_time_median"], "s"),
        ]

    def _section(
        self, key: str, title: str, text: str, table: tuple[list[str], list[list[str]]], image: str = ""
    ) -> Section:
        return Section(key, title, text, self.config.command(key), *table, image, [f"{key}.json", f"{key}.parquet"])

    def _show(self, key: str, shown: Shown, runs: RunTable, values: dict[str, Any]) -> Section:
        """Write a figure and its data, and return its section."""
        save_figure(shown.figure, self.config.output / f"{key}.png")
        write_parquet(self.config.output / f"{key}.parquet", runs)
        section = self._section(key, shown.title, shown.text, shown.table, f"{key}.png")
        self._write(section, values)
        return section

    def _write(self, section: Section, values: dict[str, Any]) -> None:
        write_json(self.config.output / f"{section.key}.json", values | {"section": section.as_json()})

    def _progress(self, description: str, total: float) -> AbstractContextManager[Advance]:
        return progress_bar(self.console, description, total)


def trajectory_table(trajectories: Sequence[Trajectory]) -> RunTable:
    """Return the poses of single runs as rows of team size, time [s], robot, x [m], y [m] and heading [rad]."""
    tables = []
    for trajectory in trajectories:
        poses = trajectory.poses[0]
        records, robots = poses.shape[:2]
        tables.append(
            {
                "robots": np.full(records * robots, robots),
                "time": np.repeat(trajectory.time, robots),
                "robot": np.tile(np.arange(robots), records),
                "x": poses[..., 0].ravel(),
                "y": poses[..., 1].ravel(),
                "heading": poses[..., 2].ravel(),
            }
        )
    return concatenate(tables)
