"""Controllers side by side over many team sizes and profiles: the work of ``triform compare``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from triform.control import ControllerSpec
from triform.evaluation.runs import Execution
from triform.evaluation.scenario import GUARDS, Scenario
from triform.experiments.cell import Cell
from triform.experiments.grid import Grid, measure_in_folder, open_grid, spread_out
from triform.experiments.paired import Row, compare_rows, explain_p, format_p
from triform.experiments.settings import LARGE_TEAM, LARGE_TEAM_TIME, MOST_RUNS, check_teams, for_team, team_sizes
from triform.limits import require_at_most
from triform.report.listener import SILENT, Listener
from triform.report.page import Section, say_written, spell_command, write_pages
from triform.report.tables import BRACKETS, drop_columns
from triform.timing.step_time import TEAM, network_size, record_views, step_times, what_it_sees
from triform.types import convert_fields, require

#: Name of all files.
_NAME = "compare"
#: The profile of the second group of team sizes, like the paper's real robots.
REAL_PROFILE = "hardware"

_CONTROLLERS = (
    "policy:default", "policy:short", "policy:cnn", "gnn:gnn", "policy:paper", "policy:large", "scan-pipeline",
    "scan-triangulating", "expert", "expert-sensed", "expert-odd", "triangulating",
)  # fmt: skip
#: Title, key in a summary, format, measure of a run and explanation of the tables that follow the first one.
_TABLES = (
    (
        "Success", "success", "%", "success",
        "Share of runs whose formation error, averaged over the last 5 s, is below 10 %.",
    ),
    ("Median error", "formation_error_median", "%%", "formation_error", "Median formation error of the last 5 s."),
    (
        "Strict at", "strict_time_median", "s", "strict_time",
        "Median time from which runs are strict to the end, of those that are.",
    ),
)  # fmt: skip
#: Columns that a terminal of 80 characters has no room for.
_UNSHOWN = ("sees", "parameters")


@dataclass(frozen=True)
class CompareConfig:
    """A comparison of controllers on the same starts.

    Attributes:
        controllers: Controllers, such as policy:paper, triangulating or FILE.py:CLASS. One that cannot be made, such as
            one whose weights are missing, is left out.
        robots: Team sizes in the scenario's profile; teams of more than 13 robots get three times the duration.
        hardware_robots: Team sizes in the hardware profile.
        runs: Runs of each team of at most 13 robots.
        large_runs: Runs of each larger team.
        seed: A run is a function of profile, team size, seed and index alone.
        output: Folder for the results, from which a comparison that was stopped goes on.
        scenario: Everything else about the runs.
        execution: Where the runs are computed.
    """

    controllers: tuple[ControllerSpec, ...] = tuple(map(ControllerSpec.parse, _CONTROLLERS))
    robots: tuple[int, ...] = (5, 7, 9, 11, 13, 25, 50, 100)
    hardware_robots: tuple[int, ...] = (4, 5, 7, 9)
    runs: int = 100
    large_runs: int = 20
    seed: int = 7
    output: Path = Path("compare")
    scenario: Scenario = field(default_factory=Scenario)
    execution: Execution = field(default_factory=Execution)

    def __post_init__(self) -> None:
        convert_fields(self)
        object.__setattr__(self, "robots", team_sizes(self.scenario, self.robots, CompareConfig.robots))
        require(len(self.controllers) > 0, "controllers is empty; at least one controller is needed")
        labels = [controller.label for controller in self.compared]
        for label in labels:
            require(labels.count(label) == 1, f"controllers names {label} {labels.count(label)} times; once is enough")
        check_teams((*self.robots, *self.hardware_robots), self.runs, self.seed)
        require(self.large_runs >= 1, f"large_runs is {self.large_runs}; at least 1 is needed")
        require_at_most("large_runs", self.large_runs, MOST_RUNS)

    @property
    def compared(self) -> list[ControllerSpec]:
        """The controllers to compare; one that has weights gets its default ones if none are named."""
        return [controller.resolved for controller in self.controllers]

    @property
    def columns(self) -> list[tuple[str, int]]:
        """Profile and team size of every column of a table."""
        first = [(self.scenario.profile, robots) for robots in dict.fromkeys(self.robots)]
        return first + [(REAL_PROFILE, robots) for robots in dict.fromkeys(self.hardware_robots)]

    @property
    def cells(self) -> list[Cell]:
        """What is run, controller by controller."""
        return [self._cell(controller, *column) for controller in self.compared for column in self.columns]

    @property
    def command(self) -> str:
        """The command that makes the comparison again."""
        return spell_command(["triform", "compare"], self)

    def _cell(self, controller: ControllerSpec, profile: str, robots: int) -> Cell:
        label, scenario = controller.label, for_team(replace(self.scenario, profile=profile), robots)
        runs = self.large_runs if robots > LARGE_TEAM else self.runs
        name, labels = f"{label}, {robots} robots, {profile}", {"label": label, "profile": profile}
        return Cell(labels, scenario, controller, robots, runs, self.seed, name, label)


@dataclass(frozen=True)
class Cost:
    """What a controller sees and costs.

    Attributes:
        sees: From what it computes a robot's command.
        parameters: Numbers of its network; ``None`` if it has none.
        step_time: Median time of one robot's step on one thread [s].
    """

    sees: str
    parameters: int | None
    step_time: float


def run_compare(config: CompareConfig, listener: Listener = SILENT) -> list[Path]:
    """Run all controllers with all team sizes, and write tables and a page.

    All files are rewritten whenever a cell is done. The same command goes on from there, and so does one with more
    controllers or team sizes. Times of steps are measured anew, of all controllers in turns, before anything is run.

    Args:
        config: What to run and where to put it.
        listener: Hears of progress, tables and files.

    Returns:
        The pages written.

    Raises:
        TriformError: The folder cannot be written or holds something else, or nothing can be run.
    """
    with open_grid(config.output, _NAME, lambda _: config.cells) as grid:
        with listener.progress("timing steps", 1):
            costs = find_costs(config, grid)
        controllers = [{"label": label} | asdict(each) for label, each in costs.items()]

        def paired() -> list[Row]:
            return compare_rows(grid, grid.cells)

        def more() -> dict[str, Any]:
            rows = [row.as_json() for row in paired()]
            return {"controllers": controllers, "skipped": grid.skipped, "paired": rows}

        def write(summaries: Sequence[dict[str, Any]]) -> tuple[list[Section], list[Path]]:
            sections = list_sections(config, summaries, costs, grid.skipped, paired())
            return sections, write_pages(config.output, "Controllers side by side", sections, _NAME)

        sections, pages = write(measure_in_folder(config, _NAME, grid, listener, more, on_summaries=write))
        # The other tables would fill many screens.
        for section, note in zip(sections, ("", f"{BRACKETS} {explain_p(paired())}".rstrip()), strict=False):
            listener.table(section.title, *drop_columns(section.headings, section.rows, _UNSHOWN), note)
        say_written(listener, config.output, sections, pages)
        return pages


def find_costs(config: CompareConfig, grid: Grid) -> dict[str, Cost]:
    """Time the steps of all controllers in turns, and find out their networks' sizes; by label.

    Raises:
        TriformError: The weights of a policy cannot be read.
    """
    first = {cell.labels["label"]: cell for cell in reversed(grid.cells)}
    known = [controller for controller in config.compared if controller.label in first]
    controllers = {controller.label: grid.controller(first[controller.label]) for controller in known}
    scenario = grid.cells[0].scenario
    if scenario.team.is_mixed:
        scenario = scenario.of_first_kind
        controllers = {controller.label: scenario.make_controller(controller) for controller in known}
    seconds = step_times(controllers, record_views(scenario, config.seed))
    return {
        controller.label: Cost(what_it_sees(controller), network_size(controller), seconds[controller.label])
        for controller in known
    }


def list_sections(
    config: CompareConfig,
    summaries: Sequence[dict[str, Any]],
    costs: Mapping[str, Cost],
    skipped: Mapping[str, str],
    paired: Sequence[Row],
) -> list[Section]:
    """Return the sections of the page: what the controllers are and how often they are strict, and other measures.

    Args:
        config: What was asked for.
        summaries: What ``Grid.summaries`` returned.
        costs: What is known about every controller that can be made, by label.
        skipped: Those that cannot, with the reason.
        paired: The controllers compared with the first one.
    """
    sizes = [f"{robots}" if profile != REAL_PROFILE else f"{robots}*" for profile, robots in config.columns]

    def spread(label: str, key: str, kind: str, measure: str) -> list[str]:
        return [*spread_out(summaries, label, config.columns, key, kind), format_p(paired, measure, label=label)]

    rows = []
    for label, each in costs.items():
        parameters = "-" if each.parameters is None else f"{each.parameters:,}"
        own = [label, each.sees, parameters, f"{1e3 * each.step_time:.3f}"]
        rows.append(own + spread(label, "strict", "%", "strict"))
    headings = ["sees", "parameters", "step [ms]", *sizes, "p"]
    sections = [_section(config, "Strict runs", _overview(config, skipped, explain_p(paired)), headings, rows)]
    for title, key, kind, measure, text in _TABLES:
        rows = [[label, *spread(label, key, kind, measure)] for label in costs]
        sections.append(_section(config, title, text, [*sizes, "p"], rows))
    return sections


def _overview(config: CompareConfig, skipped: Mapping[str, str], comparisons: str) -> str:
    scenario = config.scenario
    parts = [
        f"Share of runs that end in a true triangulation, by number of robots; * in the profile {REAL_PROFILE}, the "
        f"others in the profile {scenario.profile}; a dash is what is not done, here and below, or what no run "
        "defines. The same "
        f"random starts with seed {config.seed} for every controller: {config.runs} of every team of at most "
        f"{LARGE_TEAM} robots, {scenario.duration:g} s each, and {config.large_runs} of every larger one, "
        f"{LARGE_TEAM_TIME * scenario.duration:g} s each. Arena {scenario.arena}, prescribed distance "
        f"{scenario.distance:g} m, {GUARDS[scenario.guard]}. Sees: "
        "from what a robot's command is computed, without the filter. Parameters: numbers of the network. Step: median "
        "time from one robot's scan to its command on one thread of this machine, the filter included, measured for "
        f"all controllers in turns before the runs; for those that see poses, a step of a team of {TEAM} over {TEAM}."
    ]
    if skipped:
        parts.append(f"Left out: {'; '.join(f'{label} ({why})' for label, why in skipped.items())}.")
    return " ".join([*parts, BRACKETS, comparisons]).rstrip()


def _section(config: CompareConfig, title: str, text: str, headings: list[str], rows: list[list[str]]) -> Section:
    key = title.lower().replace(" ", "-")
    files = [f"{_NAME}.json", f"{_NAME}.parquet"]
    return Section(key, title, text, config.command, ["controller", *headings], rows, "", files)
