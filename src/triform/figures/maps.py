"""Teams over time with the occupancy map of every robot: the paper's Fig. 7."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from triform.control import view_maps
from triform.evaluation.rollout import Trajectory
from triform.figures.paper import draw_snapshot, snapshot_records
from triform.figures.runs import Scene, present
from triform.figures.style import (
    FRONT_UP,
    GREEN,
    GREY,
    bounds,
    figure_style,
    footprint_outlines,
    frame,
    heading_marks,
    robot_colours,
)
from triform.policy import PolicySpec
from triform.types import ConfigurationError, FloatArray, MapArray

#: Robots whose maps fit below a snapshot.
MOST_MAPS = 9
#: Between two maps, as a share of the side of all.
_GAP = 0.04


def figure_7_maps(
    trajectories: Sequence[Trajectory], scenes: Sequence[Scene], spec: PolicySpec, names: Sequence[str]
) -> Figure:
    """Draw teams over time: true poses, ways so far and the Gabriel graph, and below them what each robot sees.

    A map is in its robot's own frame, with its front up: the robot in the middle, occupied cells in its colour, and a
    circle at d*.

    Args:
        trajectories: Single runs, B = 1; maps are drawn of those whose scans are recorded.
        scenes: What surrounds each.
        spec: The policy whose maps are shown.
        names: What each is called.
    """
    records = [snapshot_records(trajectory.time - trajectory.time[0]) for trajectory in trajectories]
    columns = max(map(len, records))
    rows = sum(2 if each.senses else 1 for each in trajectories)
    half_side = max(bounds(each.positions, scene.arena)[1] for each, scene in zip(trajectories, scenes, strict=True))
    with figure_style():
        figure = plt.figure(figsize=(2.35 * columns, 2.5 * rows))
        grid = figure.add_gridspec(rows, columns)
        row = 0
        for trajectory, scene, moments, name in zip(trajectories, scenes, records, names, strict=True):
            for column, record in enumerate(moments):
                axes = figure.add_subplot(grid[row, column])
                draw_snapshot(axes, trajectory, record, scene)
                frame(axes, trajectory.positions, scene.arena, half_side)
                axes.set_title(f"{trajectory.time[record] - trajectory.time[0]:.0f} s", loc="left")
                axes.set_ylabel(f"{name}\ny [m]" if column == 0 else "")
                axes.set_xlabel("x [m]")
                axes.tick_params(labelleft=column == 0)
                if trajectory.senses:
                    whole = figure.add_subplot(
                        grid[row + 1, column], frame_on=False, xticks=[], yticks=[], box_aspect=1
                    )
                    whole.set_ylabel("what each sees\n(front up)" if column == 0 else "")
                    _draw_maps(whole, trajectory, record, scene, spec)
            row += 2 if trajectory.senses else 1
    return figure


def _draw_maps(whole: Axes, trajectory: Trajectory, record: int, scene: Scene, spec: PolicySpec) -> None:
    """Draw the maps of the robots of a run at a record into square axes, which they fill."""
    robots = present(trajectory, record)
    colours = dict(zip(robots.tolist(), robot_colours(len(robots)), strict=True))
    shown = robots[:MOST_MAPS].tolist()
    side = int(np.ceil(np.sqrt(len(shown))))
    width = (1 + _GAP) / side - _GAP
    maps = robot_maps(trajectory, record, scene.distance, spec)
    for index, robot in enumerate(shown):
        left, top = (each * (width + _GAP) for each in (index % side, index // side))
        axes = whole.inset_axes((left, 1 - top - width, width, width))
        axes.set(xticks=[], yticks=[])
        axes.grid(visible=False)
        axes.spines[:].set(visible=True, color=colours[robot], linewidth=1.3)
        if robot in maps:
            _draw_map(axes, *maps[robot], robot, scene, colours[robot])
        else:
            axes.text(0.5, 0.5, "no map", transform=axes.transAxes, ha="center", va="center", color=GREY, fontsize=7)


def robot_maps(
    trajectory: Trajectory, record: int, distance: float, spec: PolicySpec
) -> dict[int, tuple[MapArray, float]]:
    """Return the occupancy map (H, W) of every robot at a record, and half its side [m], by the robot.

    Those are left out that are not there, or whose scans the policy cannot use.
    """
    found: dict[int, tuple[MapArray, float]] = {}
    first = 0
    for senses in trajectory.senses:
        view = senses.view(record, float(trajectory.time[record]))
        try:
            maps, config = view_maps(view, spec, distance)
        except ConfigurationError:
            pass
        else:
            for index in np.flatnonzero(view.active[0]).tolist():
                found[first + index] = maps[0, index], config.half_extent
        first += senses.robots
    return found


def _draw_map(axes: Axes, occupied: MapArray, half: float, robot: int, scene: Scene, colour: Any) -> None:
    """Draw the map of a robot with its front up and its left side on the left."""
    upright = np.ma.masked_equal(occupied[::-1, ::-1], 0)
    # Its y axis points to the left.
    extent = (half, -half, -half, half)
    axes.imshow(upright, extent=extent, cmap=ListedColormap([colour]), interpolation="nearest", zorder=2)
    axes.add_patch(Circle((0, 0), scene.distance, facecolor="none", edgecolor=GREEN, linewidth=0.8, alpha=0.45))
    own = scene.footprints(np.array([robot]))
    body: FloatArray = footprint_outlines(FRONT_UP, own)[0]
    axes.add_collection(PolyCollection([body], facecolors=[GREY], linewidths=0, zorder=3))
    axes.add_collection(LineCollection(heading_marks(FRONT_UP, own), colors="white", linewidths=0.8, zorder=4))
    axes.set(xlim=(half, -half), ylim=(-half, half), aspect="equal")
