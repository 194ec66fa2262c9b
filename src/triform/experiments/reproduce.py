"""The paper's Table I and Fig. 2 to 5 and 7 to 9 with our numbers beside its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from matplotlib.figure import Figure

from triform.control import ControllerSpec, control_steps
from triform.engines import Engine
from triform.evaluation import paper
from triform.evaluation.events import EVENT_TIME, Event, EventKind
from triform.evaluation.metrics import TOLERANCE, WINDOW, RunTable, concatenate, summarise
from triform.evaluation.rollout import Trajectory
from triform.evaluation.runs import Execution
from triform.evaluation.scenario import Scenario
from triform.experiments.compare import REAL_PROFILE
from triform.experiments.emulated import emulated_teams, write_emulated
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.experiments.real_time import STARTS, NotEmulatedError, RealTimeFigures
from triform.experiments.result import Result
from triform.experiments.settings import check_teams, describe, flat, run_memory
from triform.figures.paper import figure_2, figure_9
from triform.figures.runs import Scene, TeamChange, figure_3, figure_4, figure_5
from triform.figures.style import save_figure
from triform.limits import require_memory
from triform.report.listener import SILENT, Listener
from triform.report.output import own_folder, write_json
from triform.report.page import Section, read_sections, spell_command, write_pages
from triform.report.results import Evaluation
from triform.report.tables import (
    BRACKETS,
    LEGEND,
    WIDE,
    drop_columns,
    event_rows,
    format_measure,
    format_value,
    legend,
    require_parquet,
    summary_rows,
    write_parquet,
)
from triform.threads import limit_threads
from triform.types import (
    SENSING_RANGE,
    ConfigurationError,
    Controller,
    PrivilegedView,
    convert_fields,
    require,
)

What = Literal["table1", "fig2", "fig3", "fig4", "fig5", "fig7", "fig8", "fig9", "all"]
KEYS = [key for key in get_args(What) if key != "all"]
SIZES = tuple(paper.SUCCESS)
#: Looks as far as the paper's robots.
NEAR_POLICY = ControllerSpec("policy", "near")
#: Team sizes of Fig. 2.
SNAPSHOT_SIZES = (9, 13)
#: Team size of the table of Fig. 5, and of the shown teams to which a robot is added and from which one is removed.
_CHANGED, _SHOWN = 7, {"join": 6, "leave": 7}
#: Fig. 5 shows the first qualifying run of this many.
_CANDIDATES = 10
#: Results of emulated robots in real time.
_EMULATED = ("fig7", "fig8")
#: What the paper calls these events.
_CHANGES: dict[EventKind, str] = {"join": "addition", "leave": "removal"}
#: What the paper measured with its real robots, as results name it.
REAL_PUBLISHED = {
    "robots": paper.REAL_ROBOTS,
    "formation_error_median": paper.REAL_MEDIAN_ERROR,
    "converge_time_median": paper.REAL_CONVERGE_TIME,
}


@dataclass(frozen=True)
class ReproduceConfig:
    """A reproduction of the paper's results.

    Attributes:
        what: Which result of the paper.
        controller: Controller: a name such as policy, policy:paper or triangulating, or a class of your own as
            FILE.py:CLASS or MODULE:CLASS.
        output: Folder for the results and the page that ties them together.
        runs: Runs of each team size, and of each change of a team.
        seed: A start is a function of team size, seed and index alone.
        scenario: Everything else about the runs.
        execution: Where the runs are computed.
    """

    what: What = "all"
    controller: ControllerSpec = NEAR_POLICY
    output: Path = Path("results")
    runs: int = 100
    seed: int = 7
    scenario: Scenario = field(default_factory=partial(Scenario, sight=SENSING_RANGE))
    execution: Execution = field(default_factory=Execution)

    def __post_init__(self) -> None:
        convert_fields(self)
        require(self.what in (*KEYS, "all"), f"what is {self.what!r}; allowed are {', '.join(KEYS)} and all")
        check_teams(SIZES, self.runs, self.seed)
        scenario = self.scenario
        require(scenario.event is None, "the paper's results have no event but those of Fig. 5; leave event out")
        # What the last result would stumble over after hours.
        require_memory(run_memory(scenario, max(SIZES), _CANDIDATES), f"a run of {scenario.duration:g} s")
        control_steps(scenario.duration, scenario.robot.control_period)
        if self.what in ("fig5", "all"):
            _ = replace(scenario, event=Event("join"))
        if self.what in ("table1", "fig9", "all"):
            try:
                control_steps(scenario.duration, self.real_scenario.robot.control_period)
            except ConfigurationError as error:
                raise ConfigurationError(f"{self.what} also runs the profile {REAL_PROFILE!r}: {error}") from None
        if self.what in _EMULATED:
            emulated_teams(self.scenario, self.seed, STARTS)

    @property
    def real_scenario(self) -> Scenario:
        """Robots like the paper's real ones."""
        return replace(self.scenario, profile=REAL_PROFILE)

    def command(self, key: str) -> str:
        """Return the command that makes result ``key`` again: every option that matters to it and is no default."""
        return spell_command(["triform", "reproduce", key], self, never=("what",))


def run_reproduce(config: ReproduceConfig, listener: Listener = SILENT) -> list[Path]:
    """Produce one result, or all, and the page over everything in the folder.

    Args:
        config: What to produce and where to put it.
        listener: Hears of progress, tables and files.

    Returns:
        The pages written.

    Raises:
        TriformError: The folder cannot be written, or a name in the configuration is unknown.
    """
    require_parquet()
    pages: list[Path] = []
    execution = config.execution
    with own_folder(config.output), limit_threads(execution.threads), execution.open_engine() as engine:
        for key, make in _Reproduction(config, listener, engine).makers.items():
            try:
                section = _write(config, key, make())
            except NotEmulatedError as error:
                if config.what != "all":
                    raise
                listener.say(f"left out: {key}: {error}")
                continue
            # After every result, so that an interrupted reproduction leaves a page over what is done.
            pages = write_pages(config.output, "Results beside the paper's", read_sections(config.output, KEYS))
            headings, rows = drop_columns(section.headings, section.rows, WIDE)
            listener.table(section.title, headings, rows, legend(headings))
            for name in [*section.drawings, *section.files]:
                listener.say(f"wrote {config.output / name}")
    for page in pages:
        listener.say(f"wrote {page}")
    return pages


def _write(config: ReproduceConfig, key: str, result: Result) -> Section:
    """Write the files of a result and return its section of the page."""
    image = "" if result.figure is None else f"{key}.png"
    if result.figure is not None:
        save_figure(result.figure, config.output / image)
    data = config.output / f"{key}.parquet"
    if result.kept:
        write_emulated(data, result.kept, result.values["config"])
    else:
        write_parquet(data, result.runs)
    files = [f"{key}.json", f"{key}.parquet"]
    section = Section(key, result.title, result.text, config.command(key), *result.table, image, files)
    write_json(config.output / f"{key}.json", result.values | {"section": asdict(section)})
    return section


class _Reproduction:
    """Makes results; what two of them need is computed once."""

    def __init__(self, config: ReproduceConfig, listener: Listener, engine: Engine) -> None:
        self.config = config
        self.listener = listener
        self.engine = engine
        scenario = config.scenario
        self.scene = Scene(scenario.robot.footprint, scenario.surroundings, scenario.distance)
        methods = (
            self.table_1, self.figure_2, self.figure_3, self.figure_4, self.figure_5, self.figure_7, self.figure_8,
            self.figure_9,
        )  # fmt: skip
        makers: dict[str, Callable[[], Result]] = dict(zip(KEYS, methods, strict=True))
        self.makers = makers if config.what == "all" else {config.what: makers[config.what]}
        # Names and weights that cannot be used are found now, not after hours.
        self.controller: Controller[PrivilegedView] = scenario.make_controller(config.controller)
        self.described = flat(config, without=("what", "output", "runs")) | describe(scenario, self.controller)

    @cached_property
    def evaluation(self) -> Evaluation:
        """All runs of Table I and Fig. 4."""
        return self._evaluate(self.config.scenario, SIZES)

    @cached_property
    def real_like(self) -> Evaluation:
        """Runs of four robots like the paper's real ones, for Table I and Fig. 9."""
        return self._evaluate(self.config.real_scenario, (paper.REAL_ROBOTS,))

    def table_1(self) -> Result:
        """Success of every team size, and four robots like the paper's real ones."""
        (real,) = self.real_like.results
        headings = [
            "robots", "success paper", "success ours", "sensed ours", "strict ours",
            "error paper", "error ours", "converge paper", "converge ours",
        ]  # fmt: skip
        low, high = (f"{100 * value:.0f}" for value in paper.MEDIAN_ERROR)
        published_error, published_time = f"{low} to {high} %", format_value(paper.CONVERGE_TIME, "s")
        rows = []
        for result in self.evaluation.results:
            success = format_value(paper.SUCCESS[result["robots"]], "%")
            rows.append(_row(str(result["robots"]), success, published_error, published_time, result))
        real_error, real_time = format_value(paper.REAL_MEDIAN_ERROR, "%"), format_value(paper.REAL_CONVERGE_TIME, "s")
        rows.append(_row(f"{paper.REAL_ROBOTS}*", "-", real_error, real_time, real))
        text = (
            f"{self.config.runs} random starts per team size, {self.config.scenario.duration:g} s each, controller "
            f"{self.config.controller.label}. The paper gives one range of median errors and one converge time "
            "for all sizes. Row 4* sets the simulated hardware profile beside the paper's runs of "
            "four real robots. Errors and converge times are medians. Sensed counts only pairs within 2 d*; strict is "
            f"the share of runs that end in a true triangulation; the paper reports neither. {BRACKETS}"
        )
        published = {
            "success": paper.SUCCESS,
            "formation_error_median": paper.MEDIAN_ERROR,
            "converge_time_median": paper.CONVERGE_TIME,
            "real_robots": REAL_PUBLISHED,
        }
        values = self.evaluation.as_json() | {"hardware_profile": real, "paper": published}
        return Result("Table I: success by team size", text, (headings, rows), self.evaluation.runs, values)

    def figure_2(self) -> Result:
        """Teams of two sizes at several moments."""
        text = (
            f"The first start of each team size with seed {self.config.seed}, not selected by outcome. Every robot is "
            "its footprint with a white line to the front, and the thin line is its way so far. Edges are the "
            f"Gabriel graph, dashed where longer than robots can sense. {LEGEND}"
        )
        return self._first_runs("Fig. 2: teams over time", text, SNAPSHOT_SIZES, figure_2)

    def figure_3(self) -> Result:
        """Distance histories over trajectories of one run per team size."""
        text = (
            f"The first start of every team size with seed {self.config.seed}, not selected by outcome. Above: "
            "distances over time of the pairs that end as Gabriel neighbours, orange-red if out of "
            "sensing range at the end; the green line is the prescribed distance, the band 10 % around it. Below: "
            "where every robot started (ring), went (line) and ended (footprint, white line to the front), and the "
            f"final graph, dashed where it is longer than robots can sense. {LEGEND}"
        )
        return self._first_runs("Fig. 3: distances and trajectories", text, SIZES, figure_3)

    def figure_4(self) -> Result:
        """Box plots of formation error and converge time."""
        evaluation = self.evaluation
        text = (
            f"{self.config.runs} runs per team size. Boxes span the quartiles with the median inside, whiskers "
            "reach 1.5 times as far, dots are the runs beyond. Orange-red: the paper's range of median errors, its "
            "median converge time and its success; bars are Wilson's 95 % intervals of ours. Runs that never converge "
            f"have no converge time, so panel b shows the n others only. {LEGEND}"
        )
        title, figure = "Fig. 4: formation error and converge time", figure_4(evaluation.runs, self._label)
        return Result(title, text, summary_rows(evaluation.results), evaluation.runs, evaluation.as_json(), figure)

    def figure_5(self) -> Result:
        """Snapshots of one addition and one removal, and how many of each recover."""
        above, which_above = self._shown_change("join")
        below, which_below = self._shown_change("leave")
        found = {kind: self._evaluate(self._changing(kind), (_CHANGED,)) for kind in _CHANGES}
        summaries = [{"change": _CHANGES[kind], **found[kind].results[0]} for kind in _CHANGES]
        runs = concatenate(
            [each.runs | {"change": np.full(self.config.runs, _CHANGES[kind])} for kind, each in found.items()]
        )
        text = (
            f"Above, a robot (orange) comes to six at {EVENT_TIME:g} s; below, one of seven (orange-red) goes. "
            f"Above is {which_above}; below is {which_below}. The table is "
            f"over {self.config.runs} random additions and as many removals to teams of {_CHANGED}. Back: the mean "
            f"error of {WINDOW:g} s is below {100 * TOLERANCE:g} % again within "
            f"{self.config.scenario.duration - EVENT_TIME:g} s and "
            "stays there; linked: right after the change the pairs within 2 d* still connect everybody; sensed: back, "
            "over pairs within 2 d*; strict: the run ends in a true triangulation; recovery time: median, at least "
            f"{WINDOW:g} s as it is the time of a mean over {WINDOW:g} s. {BRACKETS}"
        )
        values = {"config": self.described, "results": summaries}
        figure = figure_5([above, below], self.scene)
        return Result("Fig. 5: a robot comes, a robot goes", text, event_rows(summaries), runs, values, figure)

    @cached_property
    def real_time(self) -> RealTimeFigures:
        """Fig. 7 and 8 of the emulated robots; Fig. 8 alone shows the runs of Fig. 7 that the folder holds."""
        config = self.config
        options = flat(config, without=("what", "output", "runs"))
        before = config.output / "fig7.parquet" if config.what == "fig8" else None
        return RealTimeFigures(config.real_scenario, config.controller, config.seed, options, before, self.listener)

    def figure_7(self) -> Result:
        """Emulated robots over time, and the occupancy maps that they see."""
        return self.real_time.figure_7()

    def figure_8(self) -> Result:
        """Distances over trajectories of the emulated robots."""
        return self.real_time.figure_8()

    def figure_9(self) -> Result:
        """Box plots of four robots like the paper's real ones."""
        real = self.real_like
        headings, rows = summary_rows(real.results)
        published = dict.fromkeys(headings, "-") | {
            "robots": f"{paper.REAL_ROBOTS} (paper)",
            "median error": format_value(paper.REAL_MEDIAN_ERROR, "%%"),
            "time": format_value(paper.REAL_CONVERGE_TIME, "s"),
        }
        text = (
            f"{self.config.runs} random starts of {paper.REAL_ROBOTS} robots in a square of 4 d* with the hardware "
            f"profile, {self.config.scenario.duration:g} s each, controller {self._label}. All are simulated; no real "
            "robot drove here. Boxes span the quartiles with the median inside, whiskers reach 1.5 times as far, dots "
            "are the runs beyond; n runs have the measure. Orange-red: the medians that the paper reports of its real "
            f"robots; it reports no more of them. {LEGEND}"
        )
        values = real.as_json() | {"paper": REAL_PUBLISHED}
        figure = figure_9(real.runs, f"{self._label}, hardware profile")
        table = (headings, [*rows, list(published.values())])
        return Result("Fig. 9: four robots like the real ones", text, table, real.runs, values, figure)

    @property
    def _label(self) -> str:
        return self.config.controller.label

    def _evaluate(self, scenario: Scenario, robots: tuple[int, ...]) -> Evaluation:
        """Run and measure the controller on the starts of this reproduction."""
        config = self.config
        asked = EvaluateConfig(config.controller, robots, config.runs, config.seed, scenario=scenario)
        return evaluate(asked, self.listener, engine=self.engine)

    def _first_runs(
        self, title: str, text: str, sizes: Sequence[int], draw: Callable[[Sequence[Trajectory], Scene], Figure]
    ) -> Result:
        """Run, measure and draw the first start of every team size."""
        scenario, seed = self.config.scenario, self.config.seed
        trajectories, results = [], []
        with self.listener.progress("running", scenario.steps * sum(sizes)) as advance:
            for robots in sizes:
                poses = scenario.sample_starts(robots, 1, seed)
                trajectory, table = scenario.run(poses, self.controller, seed, on_step=advance)
                trajectories.append(trajectory)
                results.append({"robots": int(table["robots"][0]), **summarise(table)})
        values = {"config": self.described, "results": results}
        figure = draw(trajectories, self.scene)
        return Result(title, text, summary_rows(results), trajectory_table(trajectories), values, figure)

    def _changing(self, kind: EventKind) -> Scenario:
        return replace(self.config.scenario, event=Event(kind))

    def _shown_change(self, kind: EventKind) -> tuple[TeamChange, str]:
        """Choose the run to show, and say which it is."""
        scenario, robots, seed = self._changing(kind), _SHOWN[kind], self.config.seed
        poses = scenario.sample_starts(robots, _CANDIDATES, seed)
        with self.listener.progress("changing teams", scenario.steps * poses[..., 0].size) as advance:
            trajectory, table = scenario.run(poses, self.controller, seed, on_step=advance)
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
        after = robots + 1 if kind == "join" else robots - 1
        return TeamChange(trajectory.run(shown), EVENT_TIME, f"{robots} → {after} robots"), which


def _row(robots: str, success: str, error: str, time: str, ours: dict[str, Any]) -> list[str]:
    """Return a row of Table I: what the paper reports, each measure followed by ours."""
    rates = [format_measure(ours, rate, "%") for rate in ("success", "success_sensed", "strict")]
    our_error, our_time = (
        format_value(ours["formation_error_median"], "%%"),
        format_value(ours["converge_time_median"], "s"),
    )
    return [robots, success, *rates, error, our_error, time, our_time]


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
