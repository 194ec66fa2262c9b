"""Figures of single teams over time and of four real robots: the paper's Fig. 2 and 9."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from triform.evaluation import paper
from triform.evaluation.metrics import TOLERANCE, RunTable, select
from triform.evaluation.rollout import Trajectory
from triform.figures.runs import Scene, draw_boxes, draw_formation, present
from triform.figures.style import (
    BLUE,
    GREY,
    INK,
    VERMILLION,
    bounds,
    draw_arena,
    figure_style,
    frame,
    graph_legend,
    robot_colours,
)
from triform.types import FloatArray

#: When the team is shown [s], as far as the run lasts, and at its end.
_MOMENTS = (0.0, 2.0, 5.0, 10.0, 20.0)


def snapshot_records(time: FloatArray) -> list[int]:
    """Return the records at 0, 2, 5, 10 and 20 s, of those before the end, and the last one."""
    last = len(time) - 1
    found = [int(np.searchsorted(time, moment - 1e-6)) for moment in _MOMENTS]
    return [record for record in found if record < last] + [last]


def figure_2(trajectories: Sequence[Trajectory], scene: Scene) -> Figure:
    """Draw teams over time, one row per team: footprints, headings, ways so far and the Gabriel graph.

    Args:
        trajectories: Single runs, B = 1, of equal duration.
        scene: What surrounds them.
    """
    records = snapshot_records(trajectories[0].time)
    rows, columns = len(trajectories), len(records)
    half_side = max(bounds(trajectory.positions, scene.arena)[1] for trajectory in trajectories)
    with figure_style():
        figure, panels = plt.subplots(rows, columns, figsize=(2.35 * columns, 2.7 * rows + 0.35), squeeze=False)
        for row, trajectory in enumerate(trajectories):
            for column, record in enumerate(records):
                axes = panels[row, column]
                draw_snapshot(axes, trajectory, record, scene)
                frame(axes, trajectory.positions, scene.arena, half_side)
                axes.set_title(f"{trajectory.time[record]:.0f} s", loc="left")
                axes.set_xlabel("x [m]" if row == rows - 1 else "")
                axes.set_ylabel(f"{len(present(trajectory, record))} robots\ny [m]" if column == 0 else "")
                axes.tick_params(labelleft=column == 0)
        graph_legend(figure)
    return figure


def figure_9(runs: RunTable, label: str) -> Figure:
    """Draw box plots of formation error and converge time by team size beside those of the paper's four real robots.

    Args:
        runs: One row per run.
        label: What the runs are.
    """
    sizes = sorted({int(robots) for robots in runs["robots"]})
    tables = [select(runs, runs["robots"] == robots) for robots in sizes]
    with figure_style():
        figure, (errors, times) = plt.subplots(1, 2, figsize=(5.6 + 0.8 * (len(sizes) - 1), 3.5))
        _draw_measure(errors, tables, "formation_error", paper.REAL_MEDIAN_ERROR, 100)
        errors.axhline(100 * TOLERANCE, color=GREY, linewidth=0.9, linestyle=(0, (4, 3)))
        errors.set_ylabel("formation error [%]")
        errors.set_title("a  formation error", loc="left")
        _draw_measure(times, tables, "converge_time", paper.REAL_CONVERGE_TIME, 1)
        times.set_ylabel("converge time [s]")
        times.set_title("b  converge time", loc="left")
        published = f"paper: median, {paper.REAL_ROBOTS} real robots"
        handles = [
            Line2D([], [], marker="s", color="none", mfc=BLUE, mec=INK, ms=8, label=label),
            Line2D([], [], color=VERMILLION, lw=1.6, alpha=0.6, label=published),
            Line2D([], [], color=GREY, lw=0.9, ls=(0, (4, 3)), label="success: error below 10 %"),
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=1)
    return figure


def _draw_measure(axes: Axes, tables: list[RunTable], measure: str, published: float, factor: float) -> None:
    """Draw boxes of a measure, ``factor`` times its values, by team size, and the published median."""
    sizes = [int(table["robots"][0]) for table in tables]
    draw_boxes(axes, sizes, [factor * table[measure] for table in tables])
    defined = [int(np.isfinite(table[measure]).sum()) for table in tables]
    ticks = [f"{robots}\nn={count}" for robots, count in zip(sizes, defined, strict=True)]
    axes.set_xticks(range(len(sizes)), ticks)
    axes.set_xlabel("robots")
    axes.grid(visible=False, axis="x")
    axes.axhline(factor * published, color=VERMILLION, linewidth=1.6, alpha=0.6)
    # The published value and the limit of success a little above it are always in sight.
    axes.set_ylim(0, max(axes.get_ylim()[1], 1.25 * factor * published))


def draw_snapshot(axes: Axes, trajectory: Trajectory, record: int, scene: Scene) -> None:
    """Draw the team of a single run at a record, with the ways that its robots have gone."""
    robots = present(trajectory, record)
    poses = trajectory.poses[0][: record + 1, robots]
    colours = robot_colours(len(robots))
    draw_arena(axes, scene.arena)
    for index, colour in enumerate(colours):
        axes.plot(poses[:, index, 0], poses[:, index, 1], color=colour, linewidth=1.2, alpha=0.75, zorder=2)
    draw_formation(axes, poses[-1], robots, scene, colours)
