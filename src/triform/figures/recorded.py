"""Figures of recorded runs, in the manner of the paper's experiments with real robots: Fig. 7, 8 and 9."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from triform.control import weights_folder
from triform.evaluation.metrics import RunTable
from triform.evaluation.rollout import Trajectory
from triform.figures.maps import figure_7_maps
from triform.figures.paper import figure_9
from triform.figures.runs import Scene, draw_distances, draw_error, draw_trajectories, present
from triform.figures.sheet import contact_sheet
from triform.figures.style import (
    bounds,
    figure_style,
    footprint_outlines,
    graph_legend,
    heading_marks,
    robot_colours,
    save_figure,
)
from triform.policy import read_spec

#: Fig. 7 and 8 show the first 8 runs, 4 side by side.
SHOWN, _COLUMNS = 8, 4


def draw_recorded(
    trajectories: Sequence[Trajectory], scenes: Sequence[Scene], runs: RunTable, folder: Path
) -> list[Path]:
    """Draw all figures of recorded runs.

    Args:
        trajectories: The runs, each with B = 1; if one has scans, Fig. 7 shows the first runs over time, with the maps
            that its robots saw.
        scenes: Footprint, arena and prescribed distance of each.
        runs: Their measures, one row per run.
        folder: Where to put them.

    Returns:
        The files written.
    """
    shown = trajectories[:SHOWN], scenes[:SHOWN]
    if any(trajectory.senses for trajectory in shown[0]):
        names = [_title(index, trajectory) for index, trajectory in enumerate(shown[0])]
        seventh = figure_7_maps(*shown, read_spec(weights_folder(None)), names)
    else:
        seventh = figure_7(*shown)
    figures = {"fig7": seventh, "fig8": figure_8(*shown), "fig9": figure_9(runs, "recorded")}
    figures["sheet"] = contact_sheet(trajectories, scenes, runs)
    return [path for name, figure in figures.items() for path in save_figure(figure, folder / f"{name}.png")]


def figure_7(trajectories: Sequence[Trajectory], scenes: Sequence[Scene]) -> Figure:
    """Draw the paths of single runs from the first poses (outlines) to the last ones (filled), and the final graph."""
    with figure_style():
        figure, panels = _panels(len(trajectories), 3.0)
        half_side = max(
            bounds(trajectory.positions, scene.arena)[1] for trajectory, scene in zip(trajectories, scenes, strict=True)
        )
        for index, (axes, trajectory, scene) in enumerate(zip(panels[0], trajectories, scenes, strict=True)):
            draw_trajectories(axes, trajectory, scene, half_side)
            _draw_first_poses(axes, trajectory, scene)
            axes.set_title(_title(index, trajectory), loc="left")
            axes.set_ylabel("y [m]" if index % _COLUMNS == 0 else "")
        graph_legend(figure)
    return figure


def figure_8(trajectories: Sequence[Trajectory], scenes: Sequence[Scene]) -> Figure:
    """Draw the distances of the final neighbours of single runs over time, and below them the formation error."""
    with figure_style():
        figure, (uppers, lowers) = _panels(len(trajectories), 2.2, parts=2)
        for index, (trajectory, scene) in enumerate(zip(trajectories, scenes, strict=True)):
            upper, lower = uppers[index], lowers[index]
            draw_distances(upper, trajectory, scene)
            upper.set_title(_title(index, trajectory), loc="left")
            upper.set_xlabel("")
            draw_error(lower, trajectory, scene)
            if index % _COLUMNS > 0:
                upper.set_ylabel("")
                lower.set_ylabel("")
        handles, labels = lowers[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
        for row in (uppers, lowers):
            top = max(axes.get_ylim()[1] for axes in row)
            for axes in row:
                axes.set_ylim(0, top)
    return figure


def _panels(count: int, height: float, parts: int = 1) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure of ``count`` panels, in blocks of ``parts`` rows of ``height`` [inch], and its panels by part."""
    columns = min(count, _COLUMNS)
    blocks = -(-count // columns)
    figure, grid = plt.subplots(
        parts * blocks, columns, figsize=(max(5.0, 3.0 * columns), height * parts * blocks + 0.35), squeeze=False
    )
    by_part: list[list[Axes]] = [list(grid[part::parts].flat) for part in range(parts)]
    for unused in [axes for panels in by_part for axes in panels[count:]]:
        unused.remove()
    return figure, [panels[:count] for panels in by_part]


def _title(index: int, trajectory: Trajectory) -> str:
    return f"run {index}, {len(present(trajectory, -1))} robots"


def _draw_first_poses(axes: Axes, trajectory: Trajectory, scene: Scene) -> None:
    """Draw where the robots that are there at the end were first: their outlines with a line towards the front."""
    robots = present(trajectory, -1)
    poses, footprints = trajectory.poses[0][:, robots], scene.footprints(robots)
    here = np.argmax(np.isfinite(poses[..., 0]), axis=0)
    first = poses[here, np.arange(poses.shape[1])]
    colours: Any = robot_colours(len(first))
    outlines = footprint_outlines(first, footprints)
    axes.add_collection(PolyCollection(outlines, facecolors="none", edgecolors=colours, linewidths=0.9, zorder=3))
    axes.add_collection(LineCollection(heading_marks(first, footprints), colors=colours, linewidths=0.9, zorder=3))
