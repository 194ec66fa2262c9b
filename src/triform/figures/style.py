"""How every figure and page looks: one font, one palette that colour-blind people can tell apart, robots as they are.

Edges are green at d*, blue where too short, vermillion where too long, and grey beyond 2 d*; triangles whose edges are
all right are filled green. The viewer draws by the same rules.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from triform.files import write_atomically
from triform.geometry import body_to_world, list_triangles
from triform.simulation import Arena, Footprint
from triform.types import SENSING_RANGE, BoolArray, FloatArray, MapArray

mpl.use("Agg")

#: Okabe and Ito's palette.
INK = "#1a1a1a"
GREY = "#8c8c8c"
BLUE = "#0072b2"
ORANGE = "#e69f00"
VERMILLION = "#d55e00"
GREEN = "#009e73"
PURPLE = "#cc79a7"
SKY = "#56b4e9"
#: Series of a plot, in this order.
SERIES = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY, GREY)
#: Colour and opacity of triangles whose edges are all right, and of the others.
CLOSED, OPEN = (GREEN, 0.25), (GREY, 0.12)
#: Patches of a map that hold something.
HELD = "#cfe6f5"

#: Three bytes per colour, shape (..., 3).
Colours = NDArray[np.uint8]
#: Pose of a robot in its own frame when its front is drawn upwards, shape (1, 3).
FRONT_UP = np.array([[0.0, 0.0, np.pi / 2]])

#: Edges this much off d* have the full colour of too short or too long ones; up to here they have that of d*.
_OFF, _RIGHT = 0.35, 0.04
#: Dashes of edges beyond sensing range.
DASHED = (0, (3, 3))

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
    "axes.prop_cycle": cycler(color=SERIES),
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
    # Text of vector drawings stays text.
    "pdf.fonttype": 42,
}


@contextmanager
def figure_style() -> Iterator[None]:
    """Draw in the house style while the block runs."""
    with mpl.rc_context(_STYLE):
        yield


def save_figure(figure: Figure, path: Path) -> list[Path]:
    """Write ``figure`` atomically as a bitmap, and beside it as vectors for papers, and close it.

    Equal figures give equal bytes: the files hold no date.

    Args:
        figure: The drawing.
        path: Name of the bitmap, ``.png``; that of the vector drawing ends in ``.pdf`` instead.

    Returns:
        The files written, the bitmap first.

    Raises:
        TriformError: A file cannot be written.
    """
    drawn: dict[Path, bytes] = {}
    try:
        with figure_style():
            for each, said in ((path, {}), (path.with_suffix(".pdf"), {"CreationDate": None})):
                buffer = io.BytesIO()
                figure.savefig(buffer, format=each.suffix.removeprefix("."), metadata=said)
                drawn[each] = buffer.getvalue()
    finally:
        plt.close(figure)
    for each, data in drawn.items():
        write_atomically(each, data)
    return list(drawn)


def legend_above(axes: Axes) -> None:
    """Put the legend of a panel above it, to the right of its title, where it hides no curve."""
    handles, _ = axes.get_legend_handles_labels()
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2, borderpad=0.0, ncols=len(handles),
        handlelength=1.4, handletextpad=0.5, columnspacing=1.2,
    )  # fmt: skip


def rgb(colour: Any) -> Colours:
    """Return a colour, as ``#rrggbb`` or numbers from 0 to 1, as three bytes."""
    if isinstance(colour, str):
        return np.array([int(colour[place : place + 2], 16) for place in (1, 3, 5)], dtype=np.uint8)
    return np.round(255 * np.array(colour[:3])).astype(np.uint8)


def edge_colours(lengths: FloatArray, distance: float) -> Colours:
    """Return the colours of edges by their lengths [m], shape (E, 3).

    Green is d*, blue too short, vermillion too long, and grey longer than the 2 d* that the published method sees.
    """
    off = (lengths - distance) / distance
    share = np.clip((np.abs(off) - _RIGHT) / (_OFF - _RIGHT), 0.0, 1.0)[:, None]
    far = np.where((off < 0)[:, None], rgb(BLUE), rgb(VERMILLION))
    colours = (1 - share) * rgb(GREEN) + share * far
    colours[lengths > SENSING_RANGE * distance] = rgb(GREY)
    return np.round(colours).astype(np.uint8)


def map_colours(occupancy: MapArray, patch: int, attention: FloatArray | None = None) -> Colours:
    """Return the picture of an occupancy map (H, W) with forward up and left left, shape (H, W, 3).

    Cells that hold something are dark, and light blue the patches of ``patch`` x ``patch`` cells that hold any, which
    are all that a network sees; it has none if ``patch`` is 0. The more of its ``attention`` (H / patch, W / patch) a
    patch gets, the darker its blue.
    """
    size = len(occupancy)
    image = np.full((size, size, 3), 255, dtype=np.uint8)
    if patch:
        whole = size // patch * patch
        blocks = occupancy[:whole, :whole].reshape(whole // patch, patch, whole // patch, patch)
        held: BoolArray = np.any(blocks, axis=(1, 3))
        shades = np.where(held[..., None], rgb(HELD), 255)
        if attention is not None:
            share = (0.08 + 0.92 * attention / max(float(attention.max()), 1e-9)) * held
            shades = np.round(255 - share[..., None] * (255.0 - rgb(BLUE)))
        image[:whole, :whole] = np.kron(shades, np.ones((patch, patch, 1))).astype(np.uint8)
    image[occupancy > 0] = rgb(INK)
    return image[::-1, ::-1]


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


def edge_lines(positions: FloatArray, graph: BoolArray) -> FloatArray:
    """Return the edges of ``graph`` (N, N) over ``positions`` (N, 2), shape (E, 2, 2)."""
    return positions[np.argwhere(np.triu(graph, 1))]


def draw_robots(axes: Axes, poses: FloatArray, footprints: Sequence[Footprint], colours: Sequence[Any]) -> None:
    """Draw robots at ``poses`` (N, 3) as footprints with a white line towards the front."""
    axes.add_collection(
        PolyCollection(
            footprint_outlines(poses, footprints), facecolors=colours, edgecolors="white", linewidths=0.6, zorder=4
        )
    )
    axes.add_collection(LineCollection(heading_marks(poses, footprints), colors="white", linewidths=1.1, zorder=5))


class GraphDrawing:
    """Edges and triangles of a graph, coloured by how well they fit d*; drawn once or moved from frame to frame."""

    def __init__(self, axes: Axes, distance: float, width: float = 1.3) -> None:
        """Add an empty graph.

        Args:
            axes: Where to draw.
            distance: Prescribed neighbour distance d* [m].
            width: Width of edges [pt].
        """
        self._distance = distance
        # Typed as anything because their methods carry no types.
        self.edges: Any = LineCollection([], linewidths=width, zorder=3)
        self.far: Any = LineCollection([], linewidths=0.75 * width, linestyles=DASHED, colors=GREY, zorder=3)
        self.triangles: Any = PolyCollection([], linewidths=0, zorder=1.5)
        #: The edges.
        self.lines = (self.edges, self.far)
        for artist in (self.triangles, *self.lines):
            axes.add_collection(artist)

    def show(self, positions: FloatArray, graph: BoolArray) -> None:
        """Draw the edges of ``graph`` (N, N) over ``positions`` (N, 2); those longer than 2 d* dashed."""
        lines = edge_lines(positions, graph)
        lengths = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
        near = lengths <= SENSING_RANGE * self._distance
        self.edges.set_segments(list(lines[near]))
        self.edges.set_color(edge_colours(lengths[near], self._distance) / 255)
        self.far.set_segments(list(lines[~near]))
        corners, closed = list_triangles(positions, graph, self._distance)
        self.triangles.set_verts(list(positions[corners]))
        self.triangles.set_facecolor([mpl.colors.to_rgba(*(CLOSED if each else OPEN)) for each in closed])


def edge_entries() -> list[Any]:
    """Return entries of a legend for the colours of edges and triangles."""
    edges = ((BLUE, "too short"), (GREEN, "d*"), (VERMILLION, "too long"))
    return [
        *(Line2D([], [], color=colour, lw=1.6, label=label) for colour, label in edges),
        Line2D([], [], color=GREY, lw=1.2, ls=DASHED, label="over 2 d*"),
        Patch(facecolor=CLOSED[0], alpha=CLOSED[1], label="triangle, edges within 10 %"),
    ]


def graph_legend(figure: Figure) -> None:
    """Say below a figure what the colours of edges and triangles mean."""
    entries = edge_entries()
    figure.legend(handles=entries, loc="outside lower center", ncols=len(entries), handlelength=1.8)


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
