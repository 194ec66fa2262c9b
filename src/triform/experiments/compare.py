"""Controllers side by side over many team sizes, ideal and like hardware: the work of ``triform compare``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from rich.console import Console

from triform.control import CONTROLLERS
from triform.control.registry import WITH_WEIGHTS
from triform.evaluation.scenario import BulkScenario, Scenario
from triform.experiments.grid import (
    LARGE_TEAM,
    LARGE_TEAM_TIME,
    UNRECORDED,
    Grid,
    RunCell,
    measure_waiting,
    spread_out,
)
from triform.experiments.reproduce_config import REAL_PROFILE, Contestant
from triform.report.output import prepare_folder, write_json
from triform.report.page import Section, spell_command, write_pages
from triform.report.tables import drop_columns, require_parquet, rich_table
from triform.threads import limit_threads
from triform.timing.step_time import TEAM, network_size, record_views, step_times, what_it_sees
from triform.types import require

#: Name of all files.
_NAME = "compare"
_IDEAL = "ideal"
_ALWAYS_SAID = {"runs", "seed"}
#: Options of a scenario that a comparison chooses itself.
CHOSEN = ("controller", "weights", "profile")

#: Title, key in a summary, format and explanation of the tables that follow the first one.
_TABLES = (
    ("Success", "success", "%", "Share of runs whose formation error, averaged over the last 5 s, is below 10 %."),
    ("Median error", "formation_error_median", "%%", "Median formation error of the last 5 s."),
    ("Strict at", "strict_time_median", "s", "Median time from which runs are strict to the end, of those that are."),
)
#: Columns that a terminal of 80 characters has no room for.
_UNSHOWN = ("sees", "parameters")


@dataclass(frozen=True)
class CompareConfig(BulkScenario):
    """Settings of a comparison of controllers.

    Attributes:
        controllers: Names of controllers; policy:NAME and gnn:NAME have the weights of that name or in that folder. One
            that cannot be made, such as one whose weights are not there, is left out.
        robots: Team sizes in the ideal profile; teams of more than 13 robots get three times the duration.
        hardware_robots: Team sizes in the hardware profile.
        runs: Runs of each team of at most 13 robots.
        large_runs: Runs of each larger team.
        seed: A run is a function of profile, team size, seed and index alone.
        output: Folder for the results, from which a comparison that was stopped goes on.
    """

    controllers: tuple[str, ...] = (
        "policy:default",
        "policy:short",
        "policy:cnn",
        "policy:dense",
        "gnn:gnn",
        "policy:paper",
        "policy:large",
        "scan-pipeline",
        "scan-triangulating",
        "expert",
        "expert-sensed",
        "expert-odd",
        "triangulating",
    )
    robots: tuple[int, ...] = (5, 7, 9, 11, 13, 25, 50, 100)
    hardware_robots: tuple[int, ...] = (4, 5, 7, 9)
    runs: int = 100
    large_runs: int = 20
    seed: int = 7
    output: Path = Path("compare")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in CHOSEN:
            default = next(each.default for each in fields(Scenario) if each.name == name)
            require(
                getattr(self, name) == default,
                f"{name} is {getattr(self, name)!r}; a comparison runs all its controllers in the profiles {_IDEAL} "
                f"and {REAL_PROFILE}, so it cannot be chosen",
            )
        require(len(self.controllers) > 0, "controllers is empty; at least one controller is needed")
        for contestant in self.contestants:
            require(
                contestant.controller in CONTROLLERS,
                f"there is no controller {contestant.controller!r} to compare; there are {', '.join(CONTROLLERS)}",
            )
        labels = [contestant.label for contestant in self.contestants]
        for label in labels:
            require(labels.count(label) == 1, f"controllers names {label} {labels.count(label)} times; once is enough")
        require(len(self.columns) > 0, "robots and hardware_robots are empty; at least one team size is needed")
        for robots in (*self.robots, *self.hardware_robots):
            require(robots >= 1, f"a team size is {robots}; a team has at least 1 robot")
        require(self.runs >= 1, f"runs is {self.runs}; at least 1 is needed")
        require(self.large_runs >= 1, f"large_runs is {self.large_runs}; at least 1 is needed")
        require(self.seed >= 0, f"seed is {self.seed}; it must not be negative")

    @property
    def contestants(self) -> list[Contestant]:
        """The controllers to compare; one that has weights gets its default ones if none are named."""
        named = [name.partition(":") for name in self.controllers]
        return [Contestant(controller, weights or WITH_WEIGHTS.get(controller)) for controller, _, weights in named]

    @property
    def columns(self) -> list[tuple[str, int]]:
        """Profile and team size of every column of a table."""
        ideal = [(_IDEAL, robots) for robots in dict.fromkeys(self.robots)]
        return ideal + [(REAL_PROFILE, robots) for robots in dict.fromkeys(self.hardware_robots)]

    @property
    def cells(self) -> list[RunCell]:
        """What is run, controller by controller."""
        return [self._cell(contestant, *column) for contestant in self.contestants for column in self.columns]

    @property
    def command(self) -> str:
        """The command that makes the comparison again."""
        return spell_command(["triform", "compare"], self, _ALWAYS_SAID, {*UNRECORDED, *CHOSEN})

    def _cell(self, contestant: Contestant, profile: str, robots: int) -> RunCell:
        large = robots > LARGE_TEAM
        shared = {field.name: getattr(self, field.name) for field in fields(Scenario)}
        duration = self.duration * (LARGE_TEAM_TIME if large else 1)
        changes = asdict(contestant) | {"profile": profile, "duration": duration}
        runs = self.large_runs if large else self.runs
        return RunCell(contestant.label, Scenario(**(shared | changes)), robots, runs)


@dataclass(frozen=True)
class Facts:
    """What is to be known about a controller besides its measures.

    Attributes:
        sees: From what it computes a robot's command.
        parameters: Numbers of its network; ``None`` if it has none.
        step_time: Median time of one robot's step on one thread [s].
    """

    sees: str
    parameters: int | None
    step_time: float


def run_compare(config: CompareConfig, console: Console) -> list[Path]:
    """Run all controllers with all team sizes, with progress, and write tables and a page.

    All files are rewritten whenever a cell is done. The same command goes on from there, and so does one with more
    controllers or team sizes. Times of steps are measured anew, of all controllers in turns, before anything is run.

    Args:
        config: What to run and where to put it.
        console: Where to show progress and tables.

    Returns:
        The pages written.

    Raises:
        TriformError: The folder cannot be written or holds something else, or nothing can be run.
    """
    prepare_folder(config.output)
    require_parquet()
    with limit_threads(config.threads), config.open_engine() as engine:
        measured = Grid(config.output / f"{_NAME}.parquet", config.cells, config.seed)
        with console.status("timing steps"):
            facts = find_facts(config, measured)
        measure_waiting(measured, engine, console, lambda seconds: _write(config, measured, facts, seconds))
    sections = list_sections(config, measured.summaries(), facts, measured.skipped)
    # The other tables are too wide for many terminals.
    for section in sections[:2]:
        console.print(rich_table(section.title, *drop_columns(section.headings, section.rows, _UNSHOWN)))
    pages = [config.output / f"{_NAME}.md", config.output / f"{_NAME}.html"]
    for path in [*(config.output / name for name in sections[0].files), *pages]:
        console.print(f"wrote {path}", soft_wrap=True)
    return pages


def find_facts(config: CompareConfig, measured: Grid) -> dict[str, Facts]:
    """Time the steps of all controllers in turns, and find out their networks' sizes; by label.

    Raises:
        TriformError: The weights of a policy cannot be read.
    """
    first = {cell.label: cell for cell in reversed(measured.cells)}
    known = [contestant for contestant in config.contestants if contestant.label in first]
    controllers = {contestant.label: measured.controller(first[contestant.label]) for contestant in known}
    seconds = step_times(controllers, record_views(measured.cells[0].scenario, config.seed))
    return {
        contestant.label: Facts(
            what_it_sees(contestant.controller), network_size(contestant), seconds[contestant.label]
        )
        for contestant in known
    }


def list_sections(
    config: CompareConfig,
    summaries: Sequence[dict[str, Any]],
    facts: Mapping[str, Facts],
    skipped: Mapping[str, str],
) -> list[Section]:
    """Return the sections of the page: what the controllers are and how often they are strict, and other measures.

    Args:
        config: What was asked for.
        summaries: What ``Grid.summaries`` returned.
        facts: What is known about every controller that can be made, by label.
        skipped: Those that cannot, with the reason.
    """
    sizes = [f"{robots}" if profile == _IDEAL else f"{robots}*" for profile, robots in config.columns]
    rows = []
    for label, each in facts.items():
        parameters = "-" if each.parameters is None else f"{each.parameters:,}"
        own = [label, each.sees, parameters, f"{1e3 * each.step_time:.3f}"]
        rows.append(own + spread_out(summaries, label, config.columns, "strict", "%"))
    headings = ["sees", "parameters", "step [ms]", *sizes]
    sections = [_section(config, "Strict runs", _overview(config, skipped), headings, rows)]
    for title, key, kind, text in _TABLES:
        rows = [[label, *spread_out(summaries, label, config.columns, key, kind)] for label in facts]
        sections.append(_section(config, title, text, sizes, rows))
    return sections


def _overview(config: CompareConfig, skipped: Mapping[str, str]) -> str:
    guarded = "behind" if config.guard else "without"
    parts = [
        f"Share of runs that end in a true triangulation, by number of robots; * in the profile {REAL_PROFILE}, the "
        f"others in the profile {_IDEAL}; a dash is what is not done, here and below, or what no run defines. The same "
        f"random starts with seed {config.seed} for every controller: {config.runs} of every team of at most "
        f"{LARGE_TEAM} robots, {config.duration:g} s each, and {config.large_runs} of every larger one, "
        f"{LARGE_TEAM_TIME * config.duration:g} s each. Arena {config.arena}, prescribed distance "
        f"{config.distance:g} m, {guarded} the layer that keeps robots from driving into what their scans show. Sees: "
        "from what a robot's command is computed, without that layer. Parameters: numbers of the network. Step: median "
        "time from one robot's scan to its command on one thread of this machine, the layer included, measured for all "
        f"controllers in turns before the runs; for those that see poses, a step of a team of {TEAM} over {TEAM}."
    ]
    if skipped:
        parts.append(f"Left out: {'; '.join(f'{label} ({why})' for label, why in skipped.items())}.")
    return " ".join(parts)


def _section(config: CompareConfig, title: str, text: str, headings: list[str], rows: list[list[str]]) -> Section:
    key = title.lower().replace(" ", "-")
    files = [f"{_NAME}.json", f"{_NAME}.parquet"]
    return Section(key, title, text, config.command, ["controller", *headings], rows, "", files)


def _write(config: CompareConfig, measured: Grid, facts: Mapping[str, Facts], wall_seconds: float) -> None:
    """Write the summaries and the page of everything that is done."""
    summaries = measured.summaries()
    values = {
        "config": {name: value for name, value in asdict(config).items() if name not in (*UNRECORDED, *CHOSEN)},
        "wall_seconds": round(wall_seconds, 3),
        "controllers": [{"label": label} | asdict(each) for label, each in facts.items()],
        "cells": summaries,
        "skipped": measured.skipped,
    }
    write_json(config.output / f"{_NAME}.json", values)
    sections = list_sections(config, summaries, facts, measured.skipped)
    write_pages(config.output, "Controllers side by side", sections, _NAME)
