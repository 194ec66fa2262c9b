"""What goes on the page with the paper's Fig. 2, teams over time, and Fig. 9, four robots like its real ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from triform.evaluation import paper
from triform.evaluation.metrics import RunTable, summarise
from triform.evaluation.rollout import Trajectory
from triform.experiments.evaluate import Evaluation
from triform.figures.paper import figure_2, figure_9
from triform.figures.runs import Scene
from triform.figures.style import Figure
from triform.report.tables import LEGEND, format_value, summary_rows

#: Team sizes of Fig. 2.
SNAPSHOT_SIZES = (9, 13)
#: What the paper measured with its real robots, as results name it.
REAL_PUBLISHED = {
    "robots": paper.REAL_ROBOTS,
    "formation_error_median": paper.REAL_MEDIAN_ERROR,
    "converge_time_median": paper.REAL_CONVERGE_TIME,
}


@dataclass(frozen=True)
class Shown:
    """A figure and what is said beside it.

    Attributes:
        title: Heading.
        text: What is shown and how to read it.
        table: Headings and formatted rows.
        figure: The drawing.
        results: Measures, plain JSON values.
    """

    title: str
    text: str
    table: tuple[list[str], list[list[str]]]
    figure: Figure
    results: list[dict[str, Any]]


def show_snapshots(trajectories: Sequence[Trajectory], tables: Sequence[RunTable], scene: Scene, seed: int) -> Shown:
    """Show single runs, with their measures ``tables``, at several moments."""
    results = [{"robots": int(table["robots"][0]), **summarise(table)} for table in tables]
    text = (
        f"The first start of each team size with seed {seed}, not selected by outcome. Every robot is "
        "its footprint with a white line to the front, and the thin line is its way so far. Black edges are the "
        f"Gabriel graph, dashed where longer than robots can sense. {LEGEND}"
    )
    return Shown("Fig. 2: teams over time", text, summary_rows(results), figure_2(trajectories, scene), results)


def show_real(evaluation: Evaluation) -> Shown:
    """Show simulated runs of four robots like the paper's real ones."""
    (result,) = evaluation.results
    headings, rows = summary_rows(evaluation.results)
    published = dict.fromkeys(headings, "-") | {
        "robots": f"{paper.REAL_ROBOTS} (paper)",
        "median error": format_value(paper.REAL_MEDIAN_ERROR, "%%"),
        "time": format_value(paper.REAL_CONVERGE_TIME, "s"),
    }
    controller = evaluation.config["controller"]
    text = (
        f"{result['runs']} random starts of {paper.REAL_ROBOTS} robots in a square of 4 d* with the hardware profile, "
        f"{evaluation.config['duration']:g} s each, controller {controller}. All are simulated; no real robot "
        "drove here. Boxes span the quartiles with the median inside, whiskers reach 1.5 times as far, dots are the "
        "runs beyond; n runs have the measure. Orange-red: the medians that the paper reports of its real robots; it "
        f"reports no more of them. {LEGEND}"
    )
    return Shown(
        "Fig. 9: four robots like the real ones",
        text,
        (headings, [*rows, list(published.values())]),
        figure_9(evaluation.runs, f"{controller}, hardware profile"),
        evaluation.results,
    )
