"""A run as a moving picture: the team, what one robot sees, and the formation error, side by side."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from triform.control import ControllerSpec
from triform.evaluation.metrics import TOLERANCE
from triform.evaluation.rollout import Trajectory
from triform.figures.film import FRAME_MS, write_film
from triform.figures.runs import Scene, present
from triform.figures.sensing import RobotSight, central_robot, sense_again
from triform.figures.sight import MapDrawing, ScanDrawing
from triform.figures.style import (
    BLUE,
    CLOSED,
    GREEN,
    INK,
    VERMILLION,
    Colours,
    GraphDrawing,
    draw_arena,
    edge_entries,
    figure_style,
    footprint_outlines,
    frame,
    heading_marks,
    robot_colours,
)
from triform.geometry import assess, gabriel_graph
from triform.simulation import Composition
from triform.types import BoolArray, FloatArray, IntArray

#: Size of a frame [pixels].
_WIDTH, _HEIGHT = 880, 500
#: Frames are in memory at once.
_MOST_FRAMES = 600
#: Frames from which the colours of a GIF are taken.
_SAMPLES = 6
_TRAIL = 4.0
#: Share of the light with which what is still to come is drawn.
_LATER = "#d4d4d4"


def animate(
    trajectory: Trajectory,
    scene: Scene,
    team: Composition,
    path: Path,
    *,
    controller: ControllerSpec,
    video: Path | None = None,
    speed: float = 4.0,
) -> list[Path]:
    """Write the first run of a trajectory as a GIF that repeats, and perhaps as an MP4.

    On the left is the team with its Gabriel graph and the way of the last 4 s; on the right the scan of one robot, its
    occupancy map with the patches that hold something, and the formation error, green while the team is strict. The
    title says how fast it runs.

    Args:
        trajectory: The run.
        scene: Footprint, arena, prescribed distance and event.
        team: Kinds of the robots.
        path: The GIF, written atomically.
        controller: Who steered; the map is that of its policy, or of the default one.
        video: The MP4, written atomically; none if omitted.
        speed: How many times faster than real the animation runs, at least; more if it had more than 600 frames.

    Returns:
        The files written.

    Raises:
        TriformError: A file cannot be written.
        ModuleNotFoundError: PyAV is not installed, and an MP4 is wanted.
    """
    wanted = max(1, round(speed * FRAME_MS / 1000 / trajectory.period))
    stride = max(wanted, math.ceil(len(trajectory.time) / _MOST_FRAMES))
    records = list(range(0, len(trajectory.time), stride))
    if records[-1] != len(trajectory.time) - 1:
        records.append(len(trajectory.time) - 1)
    robot = central_robot(trajectory)
    sensed = sense_again(trajectory, records, robot, team, scene.arena, controller, scene.distance)
    pace = 1000 * stride * trajectory.period / FRAME_MS
    with figure_style():
        figure = plt.figure(figsize=(_WIDTH / 100, _HEIGHT / 100), layout="none")
        try:
            title = f"{len(present(trajectory, 0))} robots, {controller.label}, {pace:.3g}x real time"
            board = _Board(figure, trajectory, scene, robot, sensed[0], title)

            def frames() -> Iterator[Colours]:
                for record, sensing in zip(records, sensed, strict=True):
                    yield board.draw(record, sensing)

            chosen = np.unique(np.linspace(0, len(records) - 1, _SAMPLES).astype(int))
            samples = [board.draw(records[each], sensed[each]) for each in chosen]
            write_film(frames(), samples, path, video)
        finally:
            plt.close(figure)
    return [path] if video is None else [path, video]


def _padded(value: float) -> str:
    """Return a number after spaces as wide as digits, so that nothing jumps."""
    return f"{value:4.1f}".replace(" ", "\N{FIGURE SPACE}")


def _place(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Add a panel at a place in pixels."""
    return figure.add_axes((left / _WIDTH, bottom / _HEIGHT, width / _WIDTH, height / _HEIGHT))


class _Board:
    """One figure in which only what moves is drawn anew from frame to frame, many times faster than all."""

    def __init__(
        self, figure: Figure, trajectory: Trajectory, scene: Scene, robot: int, first: RobotSight, title: str
    ) -> None:
        colours = robot_colours(trajectory.poses.shape[2])
        self.strict = assess(trajectory.positions[0], scene.distance, np.inf, trajectory.active[0])
        team = _place(figure, 44, 70, 390, 390)
        scan = _place(figure, 486, 264, 186, 186)
        occupancy = _place(figure, 686, 264, 186, 186)
        error = _place(figure, 500, 70, 372, 140)
        scan.set_title(f"scan of the ringed robot, {first.reach:g} m", loc="left", fontsize=9)
        occupancy.set_title("its map, and patches seen", loc="left", fontsize=9)
        figure.text(0.008, 0.972, title, fontsize=10.5, va="center")
        figure.legend(
            handles=edge_entries(), loc="lower left", bbox_to_anchor=(44 / _WIDTH, 0.012), ncols=5, fontsize=8,
            handlelength=1.5, columnspacing=1.1, handletextpad=0.5, borderpad=0,
        )  # fmt: skip
        self.panels = (
            _TeamPanel(team, trajectory, scene, robot, colours),
            _SightPanel(ScanDrawing(scan, scene, robot, colours[robot], first.reach)),
            _SightPanel(MapDrawing(occupancy, first, colours[robot])),
            _ErrorPanel(error, trajectory, scene, self.strict.edge_error, self.strict.strict),
        )
        self.now = figure.text(486 / _WIDTH, 0.972, "", fontsize=10.5, va="center")
        self.figure, self.trajectory = figure, trajectory
        # Typed as anything because its methods carry no types.
        self.canvas: Any = cast(Any, FigureCanvasAgg(figure))
        for artist in self._moving():
            artist.set_animated(True)
        self.canvas.draw()
        self.background = self.canvas.copy_from_bbox(figure.bbox)

    def _moving(self) -> list[Any]:
        return [artist for panel in self.panels for artist in panel.artists] + [self.now]

    def draw(self, record: int, sensing: RobotSight) -> Colours:
        """Draw one record; shape (H, W, 3)."""
        for panel in self.panels:
            panel.show(record, sensing)
        error = self.strict.edge_error[record]
        shown = f"error {_padded(100 * error)} %" if np.isfinite(error) else "no edges"
        strict = "strict" if self.strict.strict[record] else "not strict"
        self.now.set_text(f"{_padded(self.trajectory.time[record])} s    {shown}    {strict}")
        self.canvas.restore_region(self.background)
        for artist in self._moving():
            self.figure.draw_artist(artist)
        return np.array(self.canvas.buffer_rgba())[..., :3]


class _TeamPanel:
    """The team in the world."""

    def __init__(self, axes: Axes, trajectory: Trajectory, scene: Scene, robot: int, colours: Sequence[Any]) -> None:
        self.trajectory, self.scene, self.robot, self.colours = trajectory, scene, robot, colours
        positions, active = trajectory.positions[0], trajectory.active[0]
        self.graphs = gabriel_graph(positions, np.inf, active)
        draw_arena(axes, scene.arena)
        frame(axes, positions, scene.arena)
        axes.set_xlabel("x [m]", labelpad=1)
        axes.set_ylabel("y [m]", labelpad=1)
        self.trails: Any = LineCollection([], linewidths=1.6, alpha=0.45)
        self.graph = GraphDrawing(axes, scene.distance, 1.6)
        self.bodies: Any = PolyCollection([], edgecolors="white", linewidths=0.6)
        self.fronts: Any = LineCollection([], colors="white", linewidths=1.2)
        self.chosen: Any = Line2D([], [], ls="none", marker="o", mfc="none", mec=INK, mew=1.2)
        # As large as a robot, whatever the team's size.
        half = scene.footprints(np.array([robot]))[0].half_length
        low, high = axes.get_xlim()
        self.chosen.set_markersize(3.2 * half / (high - low) * 390 * 72 / 100)
        for artist in (self.trails, self.bodies, self.fronts):
            axes.add_collection(artist)
        axes.add_line(self.chosen)
        self.artists = (self.graph.triangles, self.trails, *self.graph.lines, self.bodies, self.fronts, self.chosen)

    def show(self, record: int, sensing: RobotSight) -> None:  # noqa: ARG002
        """Draw the team at a record."""
        robots = present(self.trajectory, record)
        poses = self.trajectory.poses[0, record, robots]
        colours, footprints = [self.colours[robot] for robot in robots], self.scene.footprints(robots)
        self.graph.show(self.trajectory.positions[0, record], self.graphs[record])
        self.trails.set_segments([self._trail(record, robot) for robot in robots])
        self.trails.set_color(colours)
        self.bodies.set_verts(footprint_outlines(poses, footprints))
        self.bodies.set_facecolor(colours)
        self.fronts.set_segments(heading_marks(poses, footprints))
        self.chosen.set_data(*self.trajectory.positions[0, record, self.robot][:, None])

    def _trail(self, record: int, robot: int) -> FloatArray:
        first = max(0, record - round(_TRAIL / self.trajectory.period))
        path = self.trajectory.positions[0, first : record + 1, robot]
        return path[np.isfinite(path[:, 0])]


class _SightPanel:
    """What one robot sees: its scan or its map."""

    def __init__(self, drawing: ScanDrawing | MapDrawing) -> None:
        self.drawing, self.artists = drawing, drawing.artists

    def show(self, record: int, sensing: RobotSight) -> None:  # noqa: ARG002
        """Draw a moment."""
        self.drawing.show(sensing)


class _ErrorPanel:
    """The formation error, grey where it is still to come, and when the team is strict."""

    def __init__(self, axes: Axes, trajectory: Trajectory, scene: Scene, error: FloatArray, strict: BoolArray) -> None:
        self.time, self.error = trajectory.time, 100 * error
        starts, ends = _stretches(strict)
        self.begun = self.time[starts]
        self.over = np.append(self.time, self.time[-1])[ends]
        self.top = 1.05 * max(200 * TOLERANCE, float(np.nanmax(self.error, initial=0.0)))
        axes.plot(self.time, self.error, color=_LATER, lw=1.2)
        axes.axhline(100 * TOLERANCE, color=GREEN, lw=1.0, ls=(0, (4, 3)))
        axes.text(1.0, 100 * TOLERANCE, f"{100 * TOLERANCE:g} % ", transform=axes.get_yaxis_transform(), ha="right",
                  va="bottom", fontsize=8, color=GREEN)  # fmt: skip
        if scene.event is not None and scene.event.interrupts:
            axes.axvline(scene.event.time, color=VERMILLION, lw=1.0, ls=(0, (4, 2)))
            axes.annotate(scene.event.kind, (scene.event.time, 1.0), (3, -2), xycoords=("data", "axes fraction"),
                          textcoords="offset points", va="top", fontsize=8, color=VERMILLION)  # fmt: skip
        axes.set_xlim(self.time[0], self.time[-1])
        axes.set_ylim(0, self.top)
        axes.set_xlabel("time [s]", labelpad=1)
        axes.set_title("formation error [%], green while strict", loc="left", fontsize=9)
        self.shade: Any = PolyCollection([], facecolor=CLOSED[0], alpha=CLOSED[1], linewidths=0)
        self.curve: Any = Line2D([], [], color=BLUE, lw=1.6)
        self.dot: Any = Line2D([], [], color=BLUE, marker="o", ms=4)
        axes.add_collection(self.shade)
        for line in (self.curve, self.dot):
            axes.add_line(line)
        self.artists = (self.shade, self.curve, self.dot)

    def show(self, record: int, sensing: RobotSight) -> None:  # noqa: ARG002
        """Draw the error up to a record."""
        now = self.time[record]
        past = [(begun, min(over, now)) for begun, over in zip(self.begun, self.over, strict=True) if begun < now]
        self.shade.set_verts([[(a, 0), (b, 0), (b, self.top), (a, self.top)] for a, b in past])
        self.curve.set_data(self.time[: record + 1], self.error[: record + 1])
        self.dot.set_data([now], [self.error[record]])


def _stretches(flags: BoolArray) -> tuple[IntArray, IntArray]:
    """Return where stretches of true flags (T,) begin, and the indices after them."""
    edges = np.diff(np.concatenate([[0], flags.astype(np.int64), [0]]))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
