"""The triangulating law with each of its terms left out: the work of ``triform ablate``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from triform.control import Triangulating, TriangulatingLaw
from triform.control.triangulating import BLOCKING_RADIUS
from triform.evaluation.runs import Execution
from triform.evaluation.scenario import GUARDS, Scenario
from triform.experiments.cell import Cell
from triform.experiments.grid import measure_in_folder, open_grid, spread_out
from triform.experiments.paired import Row, compare_rows, explain_p, format_p
from triform.experiments.settings import LARGE_TEAM, LARGE_TEAM_TIME, check_teams, for_team, team_sizes
from triform.figures.grids import ablation_figure
from triform.figures.style import save_figure
from triform.report.listener import SILENT, Listener
from triform.report.page import Section, say_written, spell_command, write_pages
from triform.report.tables import BRACKETS, drop_columns
from triform.simulation.noise import exploration_noise
from triform.types import NOISE_PERIOD, Controller, FloatArray, PrivilegedView, TriformError, convert_fields

#: Name of all files.
_NAME = "ablation"
#: Moments farther apart than this have errors of their own [s].
_ERROR_PERIOD = 1e-3

#: How the columns are called, their key in a summary, format and measure of a run.
_MEASURES = (
    ("strict", "strict", "%", "strict"),
    ("success", "success", "%", "success"),
    ("strict at", "strict_time_median", "s", "strict_time"),
)
#: Columns that a terminal of 80 characters has no room for begin so.
_UNSHOWN = ("changed", "success", "strict at", "p success", "p strict at")


@dataclass(frozen=True)
class Variant:
    """The law with something changed.

    Attributes:
        change: What is changed, as people read it.
        constants: Values of the law that are not the tuned ones, by name.
        blocking_radius: A robot hides who is behind a disc of this radius [m].
        position_noise: Standard deviation of what is seen of another robot's position, along each axis [m].
    """

    change: str = "nothing"
    constants: Mapping[str, float] = field(default_factory=dict)
    blocking_radius: float = BLOCKING_RADIUS
    position_noise: float = 0.0

    @property
    def law(self) -> TriangulatingLaw:
        """The constants of the law."""
        return replace(TriangulatingLaw(), **self.constants)

    def controller(self, distance: float) -> Controller[PrivilegedView]:
        """Make the controller for a prescribed neighbour distance d* [m]."""
        law = Triangulating(distance, law=self.law, blocking_radius=self.blocking_radius)
        return NoisyPositions(law, self.position_noise) if self.position_noise > 0 else law


def _without(*names: str) -> Variant:
    """Return the law with constants set to 0."""
    return Variant(" and ".join(f"{name} 0" for name in names), dict.fromkeys(names, 0.0))


#: Every variant by its name. Strain does not reach 10, so that no edge yields.
VARIANTS: dict[str, Variant] = {
    "whole law": Variant(),
    "no contact": _without("contact_gain"),
    "no yield": Variant("yield_strain 10, a plain spring", {"yield_strain": 10.0}),
    "no far pull": _without("far_gain"),
    "no odd spring": _without("odd_gain"),
    "no compaction": _without("compaction_speed"),
    "no bridge pull": _without("bridge_pull"),
    "no bridge push": _without("bridge_push"),
    "no hinge pull": _without("hinge_pull"),
    "no firm edges": _without("firm_degree"),
    "no strain push": _without("strain_push"),
    "no pushes": _without("bridge_push", "strain_push"),
    "sight 2.0": Variant("sight 2.0 d*", {"sight": 2.0}),
    "sees through robots": Variant("nobody hides anybody", blocking_radius=0.0),
    "noisy positions": Variant("seen positions err by 2 cm", position_noise=0.02),
}


class NoisyPositions:
    """A controller that sees poses, shown positions with random errors; a ``Controller[PrivilegedView]``.

    Every position errs by itself, the robot's own too, and the same for all who see it, anew at every moment. Errors
    are a function of the exploration noise in the view and of the time, so a run does not depend on others in the
    batch.
    """

    privileged = True

    def __init__(self, controller: Controller[PrivilegedView], noise: float) -> None:
        """Disturb what a controller sees.

        Args:
            controller: Sees true poses.
            noise: Standard deviation of one robot's position relative to another's, along each axis [m].
        """
        self._controller = controller
        self._noise = noise

    @property
    def description(self) -> dict[str, Any]:
        """What the controller says, and the noise."""
        return {**self._controller.description, "position_noise": self._noise}

    def command(self, view: PrivilegedView) -> FloatArray:
        """Return body twists (B, N, 3).

        Raises:
            TriformError: If the view carries no exploration noise.
        """
        if view.noise is None:
            raise TriformError("noisy positions need a team whose views carry exploration noise")
        keys = np.ascontiguousarray(view.noise[:, 0, 0]).view(np.uint64)
        moment = round(view.time / _ERROR_PERIOD) * NOISE_PERIOD
        poses = view.poses.copy()
        # The difference of two positions errs by both errors.
        poses[..., :2] += self._noise / np.sqrt(2) * exploration_noise(keys, poses.shape[1], moment)
        return self._controller.command(view.with_poses(poses))


@dataclass(frozen=True)
class AblateConfig:
    """An ablation of the triangulating law.

    Attributes:
        robots: Team sizes; teams of more than 13 robots get three times the duration.
        runs: Runs of every variant and team size.
        seed: A run is a function of team size, seed and index alone.
        output: Folder for the results, from which an ablation that was stopped goes on.
        scenario: Everything else about the runs.
        execution: Where the runs are computed.
    """

    robots: tuple[int, ...] = (5, 9, 13, 25)
    runs: int = 100
    seed: int = 7
    output: Path = Path(_NAME)
    scenario: Scenario = field(default_factory=Scenario)
    execution: Execution = field(default_factory=Execution)

    def __post_init__(self) -> None:
        convert_fields(self)
        object.__setattr__(self, "robots", team_sizes(self.scenario, self.robots, AblateConfig.robots))
        check_teams(self.robots, self.runs, self.seed, least=3)

    @property
    def columns(self) -> list[tuple[str, int]]:
        """Profile and team size of the columns of the table."""
        return [(self.scenario.profile, robots) for robots in dict.fromkeys(self.robots)]

    @property
    def cells(self) -> list[Cell]:
        """What is run, variant by variant."""
        cells = []
        for label, variant in VARIANTS.items():
            controller = variant.controller(self.scenario.distance)
            for profile, robots in self.columns:
                scenario = for_team(self.scenario, robots)
                name, labels = f"{label}, {robots} robots, {profile}", {"label": label, "profile": profile}
                cells.append(Cell(labels, scenario, controller, robots, self.runs, self.seed, name, name))
        return cells

    @property
    def command(self) -> str:
        """The command that makes the ablation again."""
        return spell_command(["triform", "ablate"], self)


def run_ablate(config: AblateConfig, listener: Listener = SILENT) -> list[Path]:
    """Run all variants with all team sizes, and write tables, a figure and a page.

    The tables are rewritten whenever a cell is done. The same command goes on from there.

    Args:
        config: What to run and where to put it.
        listener: Hears of progress, tables and files.

    Returns:
        The pages written.

    Raises:
        TriformError: The folder cannot be written or holds something else.
    """
    with open_grid(config.output, _NAME, lambda _: config.cells) as grid:
        variants = {label: asdict(variant) | {"law": asdict(variant.law)} for label, variant in VARIANTS.items()}

        def more() -> dict[str, Any]:
            return {"variants": variants, "paired": [row.as_json() for row in compare_rows(grid, grid.cells)]}

        summaries = measure_in_folder(config, _NAME, grid, listener, more)
        labels = list(dict.fromkeys(cell.labels["label"] for cell in grid.cells))
        save_figure(ablation_figure(summaries, labels), config.output / f"{_NAME}.png")
        paired = compare_rows(grid, grid.cells)
        section = make_section(config, summaries, paired)
        unshown = [heading for heading in section.headings if heading.startswith(_UNSHOWN)]
        shown = drop_columns(section.headings, section.rows, unshown)
        listener.table(section.title, *shown, f"{BRACKETS} {explain_p(paired)}".rstrip())
        pages = write_pages(config.output, "What the terms of the triangulating law are for", [section], _NAME)
        say_written(listener, config.output, [section], pages)
        return pages


def make_section(config: AblateConfig, summaries: Sequence[dict[str, Any]], paired: Sequence[Row]) -> Section:
    """Return the page's section over what ``Grid.summaries`` and ``compare_rows`` returned."""
    scenario = config.scenario
    text = (
        f"{config.runs} random starts per variant and team size with seed {config.seed}, "
        f"{scenario.duration:g} s each, {LARGE_TEAM_TIME * scenario.duration:g} s for more than {LARGE_TEAM} robots; "
        f"profile {scenario.profile}, arena {scenario.arena}, prescribed distance {scenario.distance:g} m, "
        f"{GUARDS[scenario.guard]}. Robots see true positions in range that "
        "no robot hides. Strict: the run ends in a true triangulation; success: the formation error of the last 5 s is "
        "below 10 %; strict at: median time from which runs are strict to the end, of those that are. Numbers in "
        "headings: robots. Bars and brackets are Wilson's 95 % intervals, the vertical line is the whole law. "
        f"{explain_p(paired)}"
    ).rstrip()
    headings = ["law", "changed"]
    for title, *_ in _MEASURES:
        headings += [*(f"{title} {robots}" for _, robots in config.columns), f"p {title}"]
    rows = []
    for label, variant in VARIANTS.items():
        row = [label, variant.change]
        for _, key, kind, measure in _MEASURES:
            row += [*spread_out(summaries, label, config.columns, key, kind), format_p(paired, measure, label=label)]
        rows.append(row)
    files = [f"{_NAME}.json", f"{_NAME}.parquet"]
    return Section(
        _NAME, "The law without each of its terms", text, config.command, headings, rows, f"{_NAME}.png", files
    )
