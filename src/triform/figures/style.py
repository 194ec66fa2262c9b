"""How every figure looks: one font, one palette that colour-blind people can tell apart, and robots as they are."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from triform.files import write_atomically
from triform.geometry import body_to_world
from triform.simulation import Arena, Footprint
from triform.types import BoolArray, FloatArray

mpl.use("Agg")

#: Okabe and Ito's palette.
INK = "#1a1a1a"
GREY = "#8c8c8c"
BLUE = "#0072b2"
ORANGE = "#e69f00"
VERMILLION = "#d55e00"
GREEN = "#009e73"
PURPLE = "#cc79a7"

_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9,
    "axes.edgecolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#ececec",
    "grid.linewidth": 0.7,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "figure.dpi": 100,
    "savefig.dpi": 200,
    "figure.constrained_layout.use": True,
}


@contextmanager
def figure_style() -> Iterator[None]:
    """Draw in the house style while the block runs."""
    with mpl.rc_context(_STYLE):
        yield


def save_figure(figure: Figure, path: Path) -> Path:
    """Write ``figure`` to ``path`` atomically, in the format that its name says, and close it."""
    buffer = io.BytesIO()
    try:
        with figure_style():
            figure.savefig(buffer, format=path.suffix.removeprefix("."))
    finally:
        plt.close(figure)
    write_atomically(path, buffer.getvalue())
    return path


def robot_colours(robots: int) -> list[Any]:
    """Return one colour per robot: evenly spaced along a map whose lightness grows steadily."""
    return [mpl.colormaps["viridis"](share) for share in np.linspace(0.0, 0.88, max(1, robots))]


def outline(footprint: Footprint) -> FloatArray:
    """Corners of an outline in the robot's frame [m], (K, 2); those of a circle are points of it."""
    if not footprint.is_circle:
        return footprint.corners
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    return footprint.half_length * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def footprint_outlines(poses: FloatArray, footprints: Sequence[Footprint]) -> list[FloatArray]:
    """Return the outline of every robot at ``poses`` (N, 3) in the world frame [m], each (K, 2)."""
    return [pose[:2] + body_to_world(outline(own), pose[2]) for pose, own in zip(poses, footprints, strict=True)]


def heading_marks(poses: FloatArray, footprints: Sequence[Footprint]) -> list[FloatArray]:
    """Return a line from the centre to the front of every robot at ``poses`` (N, 3), each (2, 2)."""
    fronts = (np.array([footprint.half_length, 0.0]) for footprint in footprints)
    return [
        np.stack([pose[:2], pose[:2] + body_to_world(front, pose[2])])
        for pose, front in zip(poses, fronts, strict=True)
    ]


def edge_lines(positions: FloatArray, graph: BoolArray) -> list[FloatArray]:
    """Return the edges of ``graph`` (N, N) over ``positions`` (N, 2), each (2, 2)."""
    first, second = np.nonzero(np.triu(graph, 1))
    return [positions[[i, j]] for i, j in zip(first, second, strict=True)]


def draw_robots(axes: Axes, poses: FloatArray, footprints: Sequence[Footprint], colours: Sequence[Any]) -> None:
    """Draw robots at ``poses`` (N, 3) as footprints with a white line towards the front."""
    axes.add_collection(
        PolyCollection(
            footprint_outlines(poses, footprints), facecolors=colours, edgecolors="white", linewidths=0.6, zorder=4
        )
    )
    axes.add_collection(LineCollection(heading_marks(poses, footprints), colors="white", linewidths=1.1, zorder=5))


def draw_edges(axes: Axes, positions: FloatArray, graph: BoolArray, **style: Any) -> None:
    """Draw the edges of ``graph`` (N, N) over ``positions`` (N, 2)."""
    options: dict[str, Any] = {"colors": INK, "linewidths": 0.9, "zorder": 3} | style
    axes.add_collection(LineCollection(edge_lines(positions, graph), **options))


def draw_arena(axes: Axes, arena: Arena) -> None:
    """Draw walls and pillars."""
    if len(arena.walls):
        axes.add_collection(LineCollection(list(arena.walls.reshape(-1, 2, 2)), colors=INK, linewidths=2, zorder=1))
    for x, y, radius in arena.pillars:
        axes.add_patch(mpl.patches.Circle((x, y), radius, facecolor=GREY, edgecolor=INK, zorder=1))


def bounds(points: FloatArray, arena: Arena, margin: float = 0.4) -> tuple[FloatArray, float]:
    """Return centre (2,) and half side of the square that holds ``points`` (..., 2) and the arena [m]."""
    corners = np.concatenate([arena.walls.reshape(-1, 2), arena.pillars[:, :2], points.reshape(-1, 2)])
    corners = corners[np.isfinite(corners).all(axis=-1)]
    low, high = corners.min(axis=0), corners.max(axis=0)
    return (low + high) / 2, float((high - low).max() / 2 + margin)


def frame(axes: Axes, points: FloatArray, arena: Arena, half_side: float | None = None) -> None:
    """Show the square around ``points`` (..., 2) and the arena, in metres, of its own or a given half side."""
    middle, half = bounds(points, arena)
    half = half_side or half
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_aspect("equal")
