"""A run as a moving picture."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any, cast

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from PIL import Image

from triform.evaluation.rollout import Trajectory
from triform.figures.runs import Scene, present
from triform.figures.style import (
    GREY,
    INK,
    draw_arena,
    edge_lines,
    figure_style,
    footprint_outlines,
    frame,
    heading_marks,
    robot_colours,
)
from triform.files import write_atomically
from triform.geometry import edge_error, gabriel_graph
from triform.types import FloatArray

_PIXELS = 520
#: A GIF has 256 colours: 32 greys, and 8 tints for each of 28 robots.
_GREYS = 32
_TINTS = (1.0, 0.85, 0.7, 0.55, 0.45, 0.35, 0.25, 0.12)
_COLOURED = 28
_FRAME_MS = 50
#: All frames are in memory at once.
_MOST_FRAMES = 1000
_LAST_FRAME_MS = 2000
_TRAIL = 4.0


def animate(trajectory: Trajectory, scene: Scene, path: Path, speed: float = 4.0) -> Path:
    """Write the first run of a trajectory to ``path`` as a GIF that repeats.

    Robots are drawn as their footprints with a white line to the front, with the Gabriel graph (edges out of
    sensing range dashed) and the way of the last 4 s.

    Args:
        trajectory: The run.
        scene: Footprint, arena and prescribed distance.
        path: File to write, atomically.
        speed: How many times faster than real the animation runs, at least; more if it had more than 1,000 frames.

    Returns:
        ``path``.

    Raises:
        TriformError: The file cannot be written.
    """
    wanted = max(1, round(speed * _FRAME_MS / 1000 / trajectory.period))
    stride = max(wanted, math.ceil(len(trajectory.time) / _MOST_FRAMES))
    records = list(range(0, len(trajectory.time), stride))
    if records[-1] != len(trajectory.time) - 1:
        records.append(len(trajectory.time) - 1)
    frames = _draw_frames(trajectory, scene, records)
    durations = [_FRAME_MS] * (len(frames) - 1) + [_LAST_FRAME_MS]
    buffer = io.BytesIO()
    frames[0].save(buffer, format="GIF", save_all=True, append_images=frames[1:], duration=durations, loop=0)
    write_atomically(path, buffer.getvalue())
    return path


def _draw_frames(trajectory: Trajectory, scene: Scene, records: list[int]) -> list[Image.Image]:
    with figure_style():
        figure = plt.figure(figsize=(_PIXELS / 100, _PIXELS / 100), layout="none")
        try:
            drawing = _Drawing(figure, trajectory, scene)
            palette = _palette(robot_colours(min(_COLOURED, trajectory.poses.shape[2])))
            none = Image.Dither.NONE
            return [drawing.draw(record).quantize(palette=palette, dither=none) for record in records]
        finally:
            plt.close(figure)


def _palette(colours: list[Any]) -> Image.Image:
    """Return a palette, the same for all frames: greys, and every colour from full to nearly white."""
    greys = [np.full(3, level) for level in np.linspace(0, 1, _GREYS)]
    tints = [1 - share * (1 - np.array(colour[:3])) for colour in colours for share in _TINTS]
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.round(255 * np.array(greys + tints)).astype(np.uint8).tobytes())
    return palette


class _Drawing:
    """One figure in which only what moves is drawn anew from frame to frame, many times faster than all."""

    def __init__(self, figure: Figure, trajectory: Trajectory, scene: Scene) -> None:
        self.trajectory = trajectory
        self.scene = scene
        self.colours = robot_colours(trajectory.poses.shape[2])
        positions, active = trajectory.positions[0], trajectory.active[0]
        self.error = edge_error(positions, scene.distance, np.inf, active)
        self.graphs = gabriel_graph(positions, np.inf, active)
        self.sensed = gabriel_graph(positions, scene.sensing_range, active)
        self.axes = figure.add_axes((0.085, 0.075, 0.895, 0.865))
        draw_arena(self.axes, scene.arena)
        frame(self.axes, positions, scene.arena)
        self.axes.set_xlabel("x [m]")
        self.axes.set_ylabel("y [m]")
        # Typed as anything because its methods carry no types.
        self.canvas: Any = cast(Any, FigureCanvasAgg(figure))
        self.canvas.draw()
        self.background = self.canvas.copy_from_bbox(figure.bbox)
        self.title = self.axes.set_title("", loc="left")
        self.trails: Any = LineCollection([], linewidths=1.6, alpha=0.45)
        self.edges: Any = LineCollection([], colors=INK, linewidths=1.0)
        self.far_edges: Any = LineCollection([], colors=GREY, linewidths=0.9, linestyles=(0, (3, 3)))
        self.bodies: Any = PolyCollection([], edgecolors="white", linewidths=0.6)
        self.fronts: Any = LineCollection([], colors="white", linewidths=1.2)
        self.moving = (self.trails, self.edges, self.far_edges, self.bodies, self.fronts)
        for artist in self.moving:
            self.axes.add_collection(artist)

    def draw(self, record: int) -> Image.Image:
        """Draw one record."""
        robots = present(self.trajectory, record)
        positions = self.trajectory.positions[0, record]
        poses = self.trajectory.poses[0, record, robots]
        colours, footprints = [self.colours[robot] for robot in robots], self.scene.footprints(robots)
        sensed = self.sensed[record]
        self.trails.set_segments([self._trail(record, robot) for robot in robots])
        self.trails.set_color(colours)
        self.edges.set_segments(edge_lines(positions, sensed))
        self.far_edges.set_segments(edge_lines(positions, self.graphs[record] & ~sensed))
        self.bodies.set_verts(footprint_outlines(poses, footprints))
        self.bodies.set_facecolor(colours)
        self.fronts.set_segments(heading_marks(poses, footprints))
        error = self.error[record]
        shown = f"formation error {100 * error:.1f} %" if np.isfinite(error) else ""
        self.title.set_text(f"{self.trajectory.time[record]:4.1f} s    {len(robots)} robots    {shown}")
        self.canvas.restore_region(self.background)
        for artist in (*self.moving, self.title):
            self.axes.draw_artist(artist)
        return Image.fromarray(np.array(self.canvas.buffer_rgba())).convert("RGB")

    def _trail(self, record: int, robot: int) -> FloatArray:
        first = max(0, record - round(_TRAIL / self.trajectory.period))
        path = self.trajectory.positions[0, first : record + 1, robot]
        return path[np.isfinite(path[:, 0])]
