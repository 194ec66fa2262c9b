"""A controller under many conditions, one varied at a time: the work of ``triform conditions``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from triform.control import POLICY, ControllerSpec, OrcaFilter
from triform.evaluation.events import EVENT_TIME, EVENTS, MEETING, MEETING_GAP, PUSH_LENGTH, Event, EventKind
from triform.evaluation.metrics import RunTable
from triform.evaluation.overrides import Overrides
from triform.evaluation.runs import Execution
from triform.evaluation.scenario import GUARDS, Scenario
from triform.experiments.cell import Cell
from triform.experiments.grid import Grid, measure_in_folder, open_grid, read_labels
from triform.experiments.paired import MEANING, Row, compare_rows, explain_p, format_p
from triform.experiments.settings import check_teams, for_team, team_sizes
from triform.figures.grids import FailedRun, conditions_figure, failures_figure
from triform.figures.runs import Scene
from triform.figures.style import save_figure
from triform.limits import require_at_most
from triform.report.listener import SILENT, Listener
from triform.report.page import Section, say_written, spell_command, write_pages
from triform.report.tables import BRACKETS, drop_columns, format_measure
from triform.simulation import ARENAS, FOOTPRINTS, Footprint
from triform.types import BoolArray, convert_fields, require

Condition = Literal[
    "range-noise", "dropped-rays", "scan-rate", "latency", "speed", "acceleration", "lag", "footprint", "arena",
    "team-size", "distance", "event", "guard",
]  # fmt: skip
CONDITIONS: tuple[Condition, ...] = get_args(Condition)

#: Name of all files but the drawing of failed runs.
_NAME = "conditions"
_MOST_DRAWN = 100
#: Columns of the page that a terminal has no room for.
_UNSHOWN = ("p success", "drift", "median error", "p error", "closest")


@dataclass(frozen=True)
class Sweep:
    """One condition and the values that it takes.

    Attributes:
        title: What is varied.
        unit: Unit of the labels; empty if they have none.
        option: The option of ``Scenario`` or ``Overrides`` that is set, or ``robots``.
        values: Values of the option, by their labels.
    """

    title: str
    unit: str
    option: str
    values: Mapping[str, Any]

    @property
    def heading(self) -> str:
        """What is varied, with the unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


def _numbers(*values: float, scale: float = 1.0) -> dict[str, float]:
    """Return values by their labels in a unit of which ``scale`` make one."""
    return {f"{value:g}": value / scale for value in values}


SWEEPS: dict[Condition, Sweep] = {
    "range-noise": Sweep("range noise", "cm", "range_noise", _numbers(0, 0.5, 1, 2, 3, 5, scale=100)),
    "dropped-rays": Sweep("dropped rays", "%", "dropout", _numbers(0, 5, 10, 20, 30, scale=100)),
    "scan-rate": Sweep("scan rate", "Hz", "scan_rate", _numbers(2, 5, 10, 20, 50)),
    "latency": Sweep("latency", "s", "latency", _numbers(0, 0.05, 0.1, 0.2, 0.3, 0.5)),
    "speed": Sweep("largest speed", "m/s", "speed_limit", _numbers(0.05, 0.1, 0.2, 0.5, 1)),
    "acceleration": Sweep("largest acceleration", "m/s²", "acceleration", _numbers(0.5, 1, 2, 4)),
    "lag": Sweep("lag of the base", "s", "lag", _numbers(0, 0.05, 0.1, 0.2, 0.3)),
    "footprint": Sweep("footprint", "", "footprint", {name: name for name in FOOTPRINTS}),
    "arena": Sweep("arena", "", "arena", {name: name for name in ARENAS}),
    "team-size": Sweep("robots", "", "robots", {str(size): size for size in (2, 3, 4, 5, 7, 9, 13, 25, 50, 100)}),
    "distance": Sweep("prescribed distance", "m", "distance", _numbers(0.6, 0.8, 1, 1.25, 1.5)),
    "event": Sweep("event", "", "event", {name: name for name in EVENTS}),
    "guard": Sweep("guard", "", "guard", {name: name for name in GUARDS}),
}


@dataclass(frozen=True)
class ConditionsConfig:
    """A sweep over conditions, one at a time around the scenario.

    Attributes:
        controller: Controller: a name such as policy, policy:paper or triangulating, or a class of your own as
            FILE.py:CLASS or MODULE:CLASS.
        which: Conditions to run; results of the others that are in the folder are kept.
        robots: Team sizes under every condition but the team size itself.
        runs: Runs of every value of a condition and team size.
        seed: A run is a function of team size, seed and index alone.
        event_time: Moment at which a robot joins, leaves or is pushed [s].
        failures: How many failed runs to draw at most.
        output: Folder for the results, from which a sweep that was stopped goes on.
        scenario: Everything else about the runs.
        execution: Where the runs are computed.
    """

    controller: ControllerSpec = POLICY
    which: tuple[Condition, ...] = CONDITIONS
    robots: tuple[int, ...] = (7, 9)
    runs: int = 100
    seed: int = 7
    event_time: float = EVENT_TIME
    failures: int = 8
    output: Path = Path("conditions")
    scenario: Scenario = field(default_factory=Scenario)
    execution: Execution = field(default_factory=Execution)

    def __post_init__(self) -> None:
        convert_fields(self)
        object.__setattr__(self, "robots", team_sizes(self.scenario, self.robots, ConditionsConfig.robots))
        require(len(self.which) > 0, "which is empty; at least one condition is needed")
        for condition in self.which:
            require(condition in CONDITIONS, f"there is no condition {condition!r}; there are {', '.join(CONDITIONS)}")
        check_teams(self.robots, self.runs, self.seed, least=2)
        require(self.failures >= 0, f"failures is {self.failures}; it must not be negative")
        require_at_most("failures", self.failures, _MOST_DRAWN)
        if "event" in self.which:
            _ = self.list_cells({"event"})

    def command(self, condition: Condition | None = None) -> str:
        """Return the command that runs one condition again, or all that were asked for."""
        config = self if condition is None else replace(self, which=(condition,))
        return spell_command(["triform", "conditions"], config)

    def list_cells(self, shown: set[str]) -> list[Cell]:
        """Return the cells of the conditions ``shown``, in the order in which they are shown."""
        return [
            self._cell(condition, label, *value)
            for condition, sweep in SWEEPS.items()
            if condition in shown
            for label, given in sweep.values.items()
            for value in self._scenarios(condition, sweep.option, given)
        ]

    def _scenarios(self, condition: Condition, option: str, value: Any) -> list[tuple[Scenario, int]]:
        """Return the scenarios and team sizes of one value of a condition."""
        base = self.scenario
        if condition == "team-size":
            return [(for_team(base, value), value)]
        if condition == "event":
            kind: EventKind = value
            sizes = (sum(MEETING),) if kind == "meet" else self.robots
            return [(replace(base, event=Event(kind, self.event_time)), robots) for robots in sizes]
        if option in {each.name for each in fields(Overrides)}:
            scenario = replace(base, overrides=replace(base.overrides, **{option: value}))
        else:
            scenario = replace(base, **{option: value})
        return [(scenario, robots) for robots in self.robots]

    def _cell(self, condition: Condition, label: str, scenario: Scenario, robots: int) -> Cell:
        sweep = SWEEPS[condition]
        name = f"{sweep.title} {label} {sweep.unit}".rstrip() + f", {robots} robots"
        if condition == "team-size":
            name = f"team of {robots}"
        labels, wanted = {"condition": condition, "label": label}, condition in self.which
        return Cell(labels, scenario, self.controller, robots, self.runs, self.seed, name, name, wanted=wanted)


def has_formed(table: RunTable) -> BoolArray:
    """Tell which runs ended as they should: strict, or successful if the team has only two robots."""
    return np.where(table["robots"] > 2, table["strict"], table["success"]).astype(np.bool_)


def failed_runs(grid: Grid, most: int) -> list[FailedRun]:
    """Run again the first failed run of at most ``most`` cells, those of all conditions in turns."""
    failing: dict[str, tuple[int, Cell, int]] = {}
    ranks: Counter[str] = Counter()
    for cell in grid.done:
        condition, table = cell.labels["condition"], grid.table(cell)
        failed = np.flatnonzero(~has_formed(table))
        digest = grid.digest(cell)
        if len(failed) and digest not in failing:
            failing[digest] = (ranks[condition], cell, int(table["run"][failed[0]]))
            ranks[condition] += 1
    drawn = []
    for _, cell, run in sorted(failing.values(), key=lambda entry: entry[0])[:most]:
        trajectory, _ = cell.run(run, 1, grid.controller(cell))
        scenario = cell.scenario
        outlines = scenario.team.outlines(trajectory.poses.shape[2])
        scene = Scene(outlines, scenario.surroundings, scenario.distance)
        drawn.append(FailedRun(trajectory, scene, f"{cell.name}, run {run}"))
    return drawn


def run_conditions(config: ConditionsConfig, listener: Listener = SILENT) -> list[Path]:
    """Run a controller under all conditions asked for, and write tables, figures and a page.

    The tables of runs and of summaries are rewritten whenever a cell is done. The same command goes on from there.

    Args:
        config: What to run and where to put it.
        listener: Hears of progress, tables and files.

    Returns:
        The pages written.

    Raises:
        TriformError: The folder cannot be written or holds something else, or nothing can be run.
    """

    def list_cells(path: Path) -> list[Cell]:
        return config.list_cells({*config.which, *read_labels(path, "condition")})

    with open_grid(config.output, _NAME, list_cells) as grid:

        def more() -> dict[str, Any]:
            paired = [row.as_json() for rows in compare_values(grid).values() for row in rows]
            return {"skipped": grid.skipped, "paired": paired}

        summaries = measure_in_folder(config, _NAME, grid, listener, more, ("output", "failures"))
        with listener.progress("drawing", 1):
            failures = failed_runs(grid, config.failures)
            headings: dict[str, str] = {name: sweep.heading for name, sweep in SWEEPS.items()}
            save_figure(conditions_figure(summaries, headings), config.output / f"{_NAME}.png")
            if failures:
                save_figure(failures_figure(failures), config.output / "failures.png")
        first = grid.controller(grid.cells[0])
        privileged = (first.controller if isinstance(first, OrcaFilter) else first).privileged
        paired = compare_values(grid)
        sections = list_sections(config, summaries, grid.skipped, len(failures), privileged, paired)
        tables = [section for section in sections if section.rows]
        for section in tables:
            shown = drop_columns(section.headings, section.rows, _UNSHOWN)
            notes = [explain_p(paired[section.key], meaning=False)]
            if section is tables[-1]:
                notes += [BRACKETS, MEANING if any(paired.values()) else ""]
            listener.table(section.title, *shown, " ".join(filter(None, notes)))
        pages = write_pages(config.output, "Under many conditions", sections, _NAME)
        say_written(listener, config.output, sections, pages)
        return pages


def compare_values(grid: Grid) -> dict[str, list[Row]]:
    """Compare the values of every condition with the first one, team size by team size; by condition."""
    found = {}
    for condition in dict.fromkeys(cell.labels["condition"] for cell in grid.cells):
        own = [cell for cell in grid.cells if cell.labels["condition"] == condition]
        found[condition] = compare_rows(grid, own, ("condition", "label", "robots"))
    return found


#: Heading, key in a summary, format, and measure of a run whose p-value follows, of the columns after the runs.
_COLUMNS = (
    ("strict", "strict", "%", "strict"),
    ("success", "success", "%", "success"),
    ("hold", "strict_hold_mean", "%", ""),
    ("strict at", "strict_time_median", "s", ""),
    ("drift", "settled_speed_median", "cm/s", ""),
    ("median error", "formation_error_median", "%%", "formation_error"),
    ("closest", "min_distance", "m", ""),
    ("overlaps", "collisions", "d", ""),
    ("hits", "arena_hits", "d", ""),
)

#: What a condition needs said besides its title.
_NOTES: dict[Condition, str] = {
    "scan-rate": "Scans per second, and commands too where the profile keeps both in step.",
    "latency": "Time from a finished scan until a command can use it; commands come once per control period.",
    "speed": "The largest speed of the base; what a controller asks beyond it is shortened.",
    "acceleration": "The ideal profile has no limit of its own.",
    "lag": "Time constant with which the base's velocity follows the command.",
    "team-size": "Teams of more than 13 robots get three times the duration. A team of two can never be strict.",
    "distance": "What robots see grows with d*, and so do starts.",
    "guard": "What stands between controller and wheels. Filter: a robot's own scan limits its command; orca: optimal "
    "reciprocal collision avoidance, which sees the true poses and velocities of all robots; none: nothing.",
}


def list_sections(
    config: ConditionsConfig,
    summaries: Sequence[dict[str, Any]],
    skipped: Mapping[str, str],
    failures: int,
    privileged: bool,
    paired: Mapping[str, Sequence[Row]],
) -> list[Section]:
    """Return the sections of the page: all conditions in one figure, a table for each, and failed runs.

    Args:
        config: What was run.
        summaries: What ``Grid.summaries`` returned.
        skipped: Cells that could not be run, with the reason.
        failures: How many failed runs are drawn.
        privileged: Whether the controller sees true poses.
        paired: What ``compare_values`` returned.
    """
    found = {summary["condition"] for summary in summaries}
    sections = [_overview(config, skipped, privileged, MEANING if any(paired.values()) else "")]
    for condition in SWEEPS:
        if condition in found:
            own = [summary for summary in summaries if summary["condition"] == condition]
            sections.append(_condition(config, condition, own, paired[condition]))
    if failures:
        text = (
            f"The first failed run of {failures} cells with a failed run, one of every condition in turns. Where every "
            "robot started (ring), went (line) and ended (footprint, white line to the front), and the final graph, "
            "dashed where it is longer than robots can sense. A run fails if it does not end strict, and that of two "
            "robots if it is no success."
        )
        sections.append(_section(config.command(), "Failed runs", text, ([], []), "failures.png"))
    return sections


def _overview(config: ConditionsConfig, skipped: Mapping[str, str], privileged: bool, meaning: str) -> Section:
    scenario = config.scenario
    parts = [
        f"Controller {config.controller.label}, {config.runs} random starts per value and team size with seed "
        f"{config.seed}, {scenario.duration:g} s each. One condition at a time differs from the profile "
        f"{scenario.profile}, the arena {scenario.arena} and a prescribed distance of {scenario.distance:g} m. Strict: "
        "the run ends in a true triangulation; success: the formation error of the last 5 s is below 10 %. Bars and "
        "brackets are Wilson's 95 % intervals. Hold: mean share of the last 5 s in which a run is strict; strict at: "
        "median time from which runs are strict to the end; drift: median speed of their robots in the last 5 s; "
        "closest: smallest distance between two centres; overlaps: runs in which two footprints ever overlapped; hits: "
        "runs in which one overlapped a wall or pillar."
    ]
    if scenario.guard != "filter":
        parts.append(f"Robots drive {GUARDS[scenario.guard]}.")
    if meaning:
        parts.append(meaning)
    if privileged:
        parts.append("This controller sees true poses at once: what a LiDAR does to scans does not reach it.")
    if skipped:
        parts.append(f"Left out: {'; '.join(f'{name} ({why})' for name, why in skipped.items())}.")
    return _section(config.command(), "All conditions", " ".join(parts), ([], []), "conditions.png")


def _condition(
    config: ConditionsConfig, condition: Condition, summaries: Sequence[dict[str, Any]], paired: Sequence[Row]
) -> Section:
    headings = [SWEEPS[condition].heading, "robots", "runs"]
    for heading, *_, measure in _COLUMNS:
        headings += [heading, f"p {heading.split()[-1]}"] if measure and paired else [heading]
    rows = []
    for summary in summaries:
        key = {name: summary[name] for name in ("condition", "label", "robots")}
        row = [summary["label"], str(summary["robots"]), str(summary["runs"])]
        for _, name, kind, measure in _COLUMNS:
            row.append(format_measure(summary, name, kind))
            if measure and paired:
                row.append(format_p(paired, measure, **key))
        rows.append(row)
    if condition == "team-size":
        headings, rows = headings[1:], [row[1:] for row in rows]
    text = f"{_note(config, condition)} {explain_p(paired, meaning=False)}".rstrip()
    return _section(config.command(condition), condition.replace("-", " ").capitalize(), text, (headings, rows))


def _note(config: ConditionsConfig, condition: Condition) -> str:
    if condition == "event":
        return (
            f"Stuck: one robot never moves. Meet: teams of {MEETING[0]} and {MEETING[1]}, whose nearest robots start "
            f"{MEETING_GAP:g} d* apart. At {config.event_time:g} s a robot joins, leaves, or is pushed by "
            f"{PUSH_LENGTH:g} d* away from the team's centre. Times count from the start. Measures are those from the "
            "event on, but for overlaps and hits."
        )
    if condition == "footprint":
        return "; ".join(f"{name}: {_outline(footprint)}" for name, footprint in FOOTPRINTS.items()) + "."
    return _NOTES.get(condition, f"Everything but the {condition.replace('-', ' ')} as above.")


def _outline(footprint: Footprint) -> str:
    if footprint.is_circle:
        return f"a circle of radius {footprint.half_length:g} m"
    return f"a box of {footprint.length:g} m x {footprint.width:g} m"


def _section(command: str, title: str, text: str, table: tuple[list[str], list[list[str]]], image: str = "") -> Section:
    key = title.lower().replace(" ", "-")
    return Section(key, title, text, command, *table, image, ["conditions.json", "conditions.parquet"])
