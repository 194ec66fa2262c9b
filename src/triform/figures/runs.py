"""Figures of runs and of evaluations, among them the paper's Fig. 3, 4 and 5."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from triform.evaluation import paper
from triform.evaluation.events import Event
from triform.evaluation.metrics import TOLERANCE, RunTable, select, trailing_mean
from triform.evaluation.rollout import Trajectory
from triform.evaluation.statistics import wilson_interval
from triform.figures.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    VERMILLION,
    GraphDrawing,
    bounds,
    draw_arena,
    draw_robots,
    figure_style,
    frame,
    graph_legend,
    legend_above,
    robot_colours,
)
from triform.geometry import edge_error, gabriel_graph
from triform.simulation import Arena, Footprint
from triform.types import SENSING_RANGE, BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Scene:
    """What a drawing of a run needs besides the run.

    Attributes:
        footprint: Outline of all robots, or of each.
        arena: Walls and pillars.
        distance: Prescribed neighbour distance d* [m].
        event: What happens during the run.
    """

    footprint: Footprint | tuple[Footprint, ...]
    arena: Arena
    distance: float = 1.0
    event: Event | None = None

    @property
    def sensing_range(self) -> float:
        """How far one robot sees another, 2 d* [m]."""
        return SENSING_RANGE * self.distance

    def footprints(self, robots: IntArray) -> list[Footprint]:
        """Return the outlines of some robots, shape (M,)."""
        given = self.footprint
        return [given] * len(robots) if isinstance(given, Footprint) else [given[robot] for robot in robots]


def present(trajectory: Trajectory, record: int) -> IntArray:
    """Return which robots of a single run exist at a record."""
    return np.flatnonzero(trajectory.active[0, record])


def draw_formation(axes: Axes, poses: FloatArray, robots: IntArray, scene: Scene, colours: Sequence[Any]) -> None:
    """Draw ``robots`` (M,) at ``poses`` (M, 3) with their Gabriel graph; edges out of sensing range are dashed."""
    positions = np.ascontiguousarray(poses[:, :2])
    GraphDrawing(axes, scene.distance).show(positions, gabriel_graph(positions))
    draw_robots(axes, poses, scene.footprints(robots), colours)


def draw_event(axes: Axes, scene: Scene) -> None:
    """Mark on an axis of time when something happens to the team."""
    if scene.event is not None and scene.event.interrupts:
        axes.axvline(scene.event.time, color=VERMILLION, linewidth=1.1, linestyle=(0, (4, 2)), label=scene.event.kind)


def draw_trajectories(axes: Axes, trajectory: Trajectory, scene: Scene, half_side: float | None = None) -> None:
    """Draw the first run: where every robot started (ring), went (line) and ended (footprint), and the graph.

    Args:
        axes: Where to draw.
        trajectory: The run.
        scene: What surrounds it.
        half_side: Half side of the region shown [m]; just large enough if omitted.
    """
    robots = present(trajectory, -1)
    poses = trajectory.poses[0][:, robots]
    colours = robot_colours(len(robots))
    draw_arena(axes, scene.arena)
    for index, colour in enumerate(colours):
        path = poses[:, index]
        axes.plot(path[:, 0], path[:, 1], color=colour, linewidth=1.4, alpha=0.75, zorder=2)
        here = np.flatnonzero(np.isfinite(path[:, 0]))[0]
        axes.plot(*path[here, :2], "o", mfc="white", mec=colour, mew=1.1, ms=4.5, zorder=3)
    draw_formation(axes, poses[-1], robots, scene, colours)
    frame(axes, poses[..., :2], scene.arena, half_side)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def draw_distances(axes: Axes, trajectory: Trajectory, scene: Scene) -> None:
    """Draw the distances over time of the pairs that end as neighbours in the first run."""
    positions = trajectory.positions[0]
    robots = present(trajectory, -1)
    graph = np.zeros((positions.shape[1],) * 2, dtype=np.bool_)
    graph[np.ix_(robots, robots)] = gabriel_graph(positions[-1, robots])
    first, second = np.nonzero(np.triu(graph, 1))
    lengths = np.linalg.norm(positions[:, first] - positions[:, second], axis=-1)
    _draw_target(axes, scene.distance)
    for length in lengths.T:
        sensed = length[-1] <= scene.sensing_range
        axes.plot(
            trajectory.time,
            length,
            color=BLUE if sensed else VERMILLION,
            alpha=0.55 if sensed else 0.9,
            linewidth=0.9,
        )
    axes.set_xlim(trajectory.time[0], trajectory.time[-1])
    axes.set_ylim(0, max(2.0 * scene.distance, 1.05 * np.nanmax(lengths, initial=0.0)))
    draw_event(axes, scene)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("distance [m]")


def draw_error(axes: Axes, trajectory: Trajectory, scene: Scene) -> None:
    """Draw the mean relative edge error over time of the first run, and its mean over 5 s."""
    time = trajectory.time
    error = edge_error(trajectory.positions[0], scene.distance, np.inf, trajectory.active[0])
    axes.axhspan(0, 100 * TOLERANCE, color=GREEN, alpha=0.12, linewidth=0)
    axes.plot(time, 100 * error, color=BLUE, label="now")
    axes.plot(time, 100 * trailing_mean(error, time), color=ORANGE, label="mean of 5 s")
    draw_event(axes, scene)
    axes.set_xlim(time[0], time[-1])
    axes.set_ylim(0, 105 * max(2 * TOLERANCE, np.nanmax(error, initial=0.0)))
    axes.set_xlabel("time [s]")
    axes.set_ylabel("formation error [%]")


def run_figure(trajectory: Trajectory, scene: Scene, title: str) -> Figure:
    """Draw one run: trajectories on the left, distances and formation error over time on the right."""
    with figure_style():
        figure = plt.figure(figsize=(9.2, 5.1))
        grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1))
        draw_trajectories(figure.add_subplot(grid[:, 0]), trajectory, scene)
        upper = figure.add_subplot(grid[0, 1])
        draw_distances(upper, trajectory, scene)
        upper.set_title("distances of the final neighbours", loc="left")
        upper.set_xlabel("")
        lower = figure.add_subplot(grid[1, 1])
        draw_error(lower, trajectory, scene)
        legend_above(lower)
        graph_legend(figure)
        figure.suptitle(title, x=0.01, ha="left", fontsize=10.5)
    return figure


def figure_3(trajectories: Sequence[Trajectory], scene: Scene, names: Sequence[str] = ()) -> Figure:
    """Draw runs side by side: distances above, trajectories with the final graph below.

    Args:
        trajectories: Single runs, B = 1.
        scene: What surrounds them.
        names: What each is called; its number of robots if omitted.
    """
    with figure_style():
        columns = len(trajectories)
        figure, axes = plt.subplots(2, columns, figsize=(2.75 * columns, 5.7), squeeze=False)
        half_side = max(bounds(trajectory.positions, scene.arena)[1] for trajectory in trajectories)
        for column, trajectory in enumerate(trajectories):
            upper, lower = axes[:, column]
            draw_distances(upper, trajectory, scene)
            draw_trajectories(lower, trajectory, scene, half_side)
            upper.set_title(names[column] if names else f"{len(present(trajectory, -1))} robots", loc="left")
            if column > 0:
                upper.set_ylabel("")
                lower.set_ylabel("")
        top = max(panel.get_ylim()[1] for panel in axes[0])
        for panel in axes[0]:
            panel.set_ylim(0, top)
        graph_legend(figure)
    return figure


def figure_4(runs: RunTable, controller: str) -> Figure:
    """Draw box plots of formation error and converge time over team size, and success, beside the paper's."""
    sizes = sorted({int(robots) for robots in runs["robots"]})
    tables = [select(runs, runs["robots"] == robots) for robots in sizes]
    with figure_style():
        figure, (errors, times, success) = plt.subplots(1, 3, figsize=(10.2, 3.3))
        draw_boxes(errors, sizes, [100 * table["formation_error"] for table in tables])
        errors.axhspan(*(100 * value for value in paper.MEDIAN_ERROR), color=VERMILLION, alpha=0.25, linewidth=0)
        errors.axhline(100 * TOLERANCE, color=GREY, linewidth=0.9, linestyle=(0, (4, 3)))
        errors.set_ylabel("formation error [%]")
        errors.set_title("a  formation error", loc="left")
        draw_boxes(times, sizes, [table["converge_time"] for table in tables])
        converged = [int(np.isfinite(table["converge_time"]).sum()) for table in tables]
        times.set_xticks(range(len(sizes)), [f"{robots}\nn={n}" for robots, n in zip(sizes, converged, strict=True)])
        times.axhline(paper.CONVERGE_TIME, color=VERMILLION, linewidth=1.6, alpha=0.6)
        times.set_ylabel("converge time [s]")
        times.set_title("b  converge time", loc="left")
        _success(success, sizes, [table["success"] for table in tables])
        for axes in (errors, times, success):
            axes.set_xlabel("robots")
            axes.grid(visible=False, axis="x")
        _legend_4(figure, controller)
    return figure


@dataclass(frozen=True)
class TeamChange:
    """A run in which the team changed.

    Attributes:
        trajectory: The run, B = 1.
        time: When a robot came or went [s]; the record of this time shows the changed team.
        title: What happened.
    """

    trajectory: Trajectory
    time: float
    title: str


def figure_5(changes: Sequence[TeamChange], scene: Scene) -> Figure:
    """Draw snapshots and the error history of runs in which a robot came or went, one row per run."""
    with figure_style():
        figure = plt.figure(figsize=(14.2, 2.75 * len(changes) + 0.35))
        grid = figure.add_gridspec(len(changes), 6, width_ratios=(1, 1, 1, 1, 1, 1.65))
        for row, change in enumerate(changes):
            _draw_change(figure, grid, row, change, scene)
        graph_legend(figure)
    return figure


def _draw_change(figure: Figure, grid: Any, row: int, change: TeamChange, scene: Scene) -> None:
    trajectory = change.trajectory
    changed = int(np.searchsorted(trajectory.time, change.time - 1e-6))
    settled = int(np.searchsorted(trajectory.time, change.time + 4 - 1e-6))
    moments = (
        (0, "start"),
        (changed - 1, "before"),
        (changed, "changed"),
        (min(settled, len(trajectory.time) - 1), "after"),
        (len(trajectory.time) - 1, "end"),
    )
    everywhere = trajectory.positions[0][[record for record, _ in moments]]
    for column, (record, name) in enumerate(moments):
        axes = figure.add_subplot(grid[row, column])
        _draw_snapshot(axes, change, changed, record, scene)
        frame(axes, everywhere, scene.arena)
        axes.set_title(f"{trajectory.time[record]:.1f} s, {name}", loc="left")
        axes.set_xlabel("x [m]")
        axes.set_ylabel(f"{change.title}\ny [m]" if column == 0 else "")
        axes.tick_params(labelleft=column == 0)
    history = figure.add_subplot(grid[row, len(moments)])
    draw_error(history, trajectory, scene)
    history.axvline(change.time, color=VERMILLION, linewidth=1.1, label="team changes")
    legend_above(history)


def _draw_snapshot(axes: Axes, change: TeamChange, changed: int, record: int, scene: Scene) -> None:
    """Draw the team at a record: who came is highlighted, who goes or went too, by a cross."""
    active = change.trajectory.active[0]
    poses = change.trajectory.poses[0]
    robots = present(change.trajectory, record)
    came = active[changed] & ~active[changed - 1]
    went = active[changed - 1] & ~active[changed]
    colours = [ORANGE if came[robot] else VERMILLION if went[robot] else BLUE for robot in robots]
    draw_arena(axes, scene.arena)
    draw_formation(axes, poses[record, robots], robots, scene, colours)
    if record >= changed:
        gone = poses[changed - 1, went, :2]
        axes.plot(gone[:, 0], gone[:, 1], "x", color=VERMILLION, ms=6, mew=1.4, zorder=4)


def _draw_target(axes: Axes, distance: float) -> None:
    low, high = (1 - TOLERANCE) * distance, (1 + TOLERANCE) * distance
    axes.axhspan(low, high, color=GREEN, alpha=0.18, linewidth=0)
    axes.axhline(distance, color=GREEN, linewidth=0.9)


def draw_boxes(axes: Axes, sizes: list[int], columns: list[FloatArray]) -> None:
    """Draw one box for each column of values that are defined, labelled by team size, from zero up."""
    defined = [column[np.isfinite(column)] for column in columns]
    boxes = axes.boxplot(
        defined,
        positions=range(len(sizes)),
        widths=0.5,
        patch_artist=True,
        medianprops={"color": INK, "linewidth": 1.4},
        boxprops={"facecolor": BLUE, "edgecolor": INK, "linewidth": 0.8},
        whiskerprops={"color": INK, "linewidth": 0.8},
        capprops={"color": INK, "linewidth": 0.8},
        flierprops={"marker": "o", "ms": 2.5, "mfc": GREY, "mec": "none", "alpha": 0.8},
    )
    for patch in boxes["boxes"]:
        patch.set_zorder(2)
    axes.set_xticks(range(len(sizes)), [str(robots) for robots in sizes])
    axes.set_ylim(bottom=0)


def _success(axes: Axes, sizes: list[int], successes: list[BoolArray]) -> None:
    rates = [100 * float(success.mean()) for success in successes]
    intervals = 100 * np.array([wilson_interval(int(success.sum()), len(success)) for success in successes]).T
    bars = np.maximum(0.0, [rates - intervals[0], intervals[1] - rates])
    published = [100 * paper.SUCCESS.get(robots, np.nan) for robots in sizes]
    positions = np.arange(len(sizes))
    axes.plot(positions, published, "D", color=VERMILLION, ms=8, mfc="white", mew=1.3)
    axes.errorbar(positions, rates, yerr=bars, fmt="o", color=BLUE, ms=4.5, elinewidth=0.8, zorder=3)
    axes.set_xticks(positions, [str(robots) for robots in sizes])
    axes.set_xlim(-0.6, len(sizes) - 0.4)
    low = np.nanmin([*intervals[0], *published, 90])
    axes.set_ylim(max(0, low - 5), 101.5)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    axes.set_ylabel("success [%]")
    axes.set_title("c  success", loc="left")


def _legend_4(figure: Figure, controller: str) -> None:
    handles = [
        Line2D([], [], marker="s", color="none", mfc=BLUE, mec=INK, ms=8, label=controller),
        Line2D(
            [], [], marker="D", mfc="white", mec=VERMILLION, color=VERMILLION, lw=5, alpha=0.5, ms=6,
            label="paper: median, success",
        ),
        Line2D([], [], color=GREY, lw=0.9, ls=(0, (4, 3)), label="success: error below 10 %"),
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
