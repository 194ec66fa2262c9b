"""A contact sheet: many runs at a glance, the failures marked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from triform.evaluation.metrics import RunTable
from triform.evaluation.rollout import Trajectory
from triform.figures.runs import Scene, present
from triform.figures.style import (
    CLOSED,
    DASHED,
    GREY,
    INK,
    OPEN,
    VERMILLION,
    bounds,
    edge_colours,
    edge_lines,
    figure_style,
    footprint_outlines,
    graph_legend,
    robot_colours,
)
from triform.geometry import gabriel_graph, list_triangles
from triform.types import FloatArray

#: Runs of a sheet; further ones are counted in its title and not drawn.
MOST = 200
#: Width of a sheet and of its largest tile [inch].
_WIDTH, _LARGEST = 10.0, 2.0
#: Share of a tile's side that is empty on each side, and for what is written above the drawing.
_MARGIN, _HEAD = 0.04, 0.13
#: A tile shows at most this many times the largest formation; ways from farther away are cut.
_WIDEST = 1.2
_FRAME, _FAINT = "#d9d9d9", 0.6
_CIRCLE = np.column_stack([np.cos(np.linspace(0, 2 * np.pi, 24)), np.sin(np.linspace(0, 2 * np.pi, 24))])


def failure(runs: RunTable, run: int) -> str:
    """Return how a run failed, in a few words: the most serious first; empty if it did not.

    Two robots can never be strict, so that theirs is no failure.
    """
    row = {name: column[run] for name, column in runs.items()}
    found = {
        "overlap": row["collision"],
        "hit the arena": row["hit_arena"],
        "no success": not row["success"],
        "not strict": row["robots"] > 2 and not row["strict"],
    }
    return next((words for words, failed in found.items() if failed), "")


def contact_sheet(trajectories: Sequence[Trajectory], scenes: Sequence[Scene], runs: RunTable) -> Figure:
    """Draw the ways and final graphs of many runs as small multiples of one scale; failures are framed.

    Args:
        trajectories: Single runs, B = 1.
        scenes: Footprint, arena and prescribed distance of each.
        runs: Their measures, one row per run, in the same order.
    """
    shown = min(len(trajectories), MOST)
    columns = max(math.ceil(_WIDTH / _LARGEST), math.ceil(math.sqrt(1.6 * shown)))
    columns = min(columns, shown)
    rows = math.ceil(shown / columns)
    side = min(_LARGEST, _WIDTH / columns)
    half = _half_side(trajectories[:shown], scenes[:shown])
    with figure_style():
        figure, axes = plt.subplots(figsize=(max(5.6, side * columns) + 0.2, side * rows + 0.85))
        sheet = _Sheet(half)
        for index in range(shown):
            place = np.array([index % columns, -(index // columns)], dtype=np.float64)
            failed = failure(runs, index)
            sheet.add(trajectories[index], scenes[index], place, failed)
            x, y = place + np.array([-0.5 + 1.6 * _MARGIN, 0.5 - 1.2 * _MARGIN])
            colour = VERMILLION if failed else GREY
            axes.text(x, y, f"{index}  {failed}", fontsize=min(8.0, 4.2 * side + 1.2), color=colour, va="top")
        sheet.draw(axes, side)
        axes.set_xlim(-0.5, columns - 0.5)
        axes.set_ylim(0.5 - rows, 0.5)
        axes.set_aspect("equal")
        axes.set_axis_off()
        graph_legend(figure)
        figure.suptitle(_title(runs, shown), x=0.01, ha="left", fontsize=10.5)
    return figure


def _title(runs: RunTable, shown: int) -> str:
    """Return how many runs ended how."""
    total = len(runs["success"])
    counts = {
        "strict": runs["strict"],
        "successful": runs["success"],
        "with an overlap": runs["collision"],
        "hit the arena": runs["hit_arena"],
    }
    sizes = sorted({int(size) for size in runs["robots"]})
    robots = f"{sizes[0]} robots" if len(sizes) == 1 else f"{sizes[0]} to {sizes[-1]} robots"
    said = ", ".join(f"{int(flags.sum())} {words}" for words, flags in counts.items())
    return f"{total} runs of {robots}: {said}" + (f"; the first {shown}" if shown < total else "")


def _half_side(trajectories: Sequence[Trajectory], scenes: Sequence[Scene]) -> float:
    """Return half the side of what a tile shows [m]: all ways, unless some come from far away."""
    pairs = list(zip(trajectories, scenes, strict=True))
    whole = max(_reach(run.positions[0], run, scene) for run, scene in pairs)
    final = max(_reach(run.positions[0, -1], run, scene) for run, scene in pairs)
    return min(whole, _WIDEST * final)


def _reach(points: FloatArray, run: Trajectory, scene: Scene) -> float:
    """Return how far points (..., 2) and the arena are from the middle of a tile, with a margin [m]."""
    arena = np.concatenate([scene.arena.walls.reshape(-1, 2), scene.arena.pillars[:, :2], points.reshape(-1, 2)])
    return float(np.nanmax(np.abs(arena - _middle(run, scene)))) + 0.3 * scene.distance


def _middle(run: Trajectory, scene: Scene) -> FloatArray:
    """Return what is in the middle of a tile (2,) [m]: the middle of the final formation, or of the arena."""
    return bounds(run.positions[0, -1], scene.arena)[0]


class _Sheet:
    """Collects all tiles into few drawings, which is many times faster than panels of their own."""

    def __init__(self, half: float) -> None:
        self.scale = (0.5 - _MARGIN - _HEAD / 2) / half
        self.limit = 0.5 - _MARGIN
        self.trails: list[tuple[FloatArray, Any]] = []
        self.edges: list[tuple[FloatArray, Any]] = []
        self.far: list[FloatArray] = []
        self.walls: list[FloatArray] = []
        self.pillars: list[FloatArray] = []
        self.triangles: list[tuple[FloatArray, Any]] = []
        self.bodies: list[tuple[FloatArray, Any]] = []
        self.frames: list[tuple[FloatArray, bool]] = []

    def add(self, run: Trajectory, scene: Scene, place: FloatArray, failed: str) -> None:
        """Add a run as the tile around ``place`` (2,)."""
        middle, centre = _middle(run, scene), place - np.array([0.0, _HEAD / 2])

        def put(points: FloatArray) -> FloatArray:
            return np.asarray(self.scale * (points - middle) + centre, dtype=np.float64)

        def cut(points: FloatArray) -> FloatArray:
            inside = (np.abs(points - place) <= self.limit).all(axis=-1, keepdims=True)
            return np.where(inside, points, np.nan)

        robots = present(run, -1)
        colours = robot_colours(len(robots))
        poses = run.poses[0, -1, robots]
        positions = np.ascontiguousarray(poses[:, :2])
        graph = gabriel_graph(positions)
        lines = edge_lines(positions, graph)
        lengths = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
        corners, closed = list_triangles(positions, graph, scene.distance)
        outlines = footprint_outlines(poses, scene.footprints(robots))
        self.walls += [put(wall) for wall in scene.arena.walls.reshape(-1, 2, 2)]
        self.pillars += [put(pillar[:2] + pillar[2] * _CIRCLE) for pillar in scene.arena.pillars]
        self.trails += [
            (cut(put(run.positions[0, :, robot])), (*colour[:3], _FAINT))
            for robot, colour in zip(robots, colours, strict=True)
        ]
        near = lengths <= scene.sensing_range
        self.edges += list(zip(put(lines[near]), edge_colours(lengths[near], scene.distance) / 255, strict=True))
        self.far += list(put(lines[~near]))
        fills = [mpl.colors.to_rgba(*(CLOSED if each else OPEN)) for each in closed]
        self.triangles += list(zip(put(positions[corners]), fills, strict=True))
        self.bodies += [(put(body), colour) for body, colour in zip(outlines, colours, strict=True)]
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        self.frames.append((place + (0.5 - 0.4 * _MARGIN) * square, bool(failed)))

    def draw(self, axes: Axes, side: float) -> None:
        """Draw all tiles, which are ``side`` wide [inch]."""
        thin = side / _LARGEST
        for failed, colour, width in ((False, _FRAME, 0.6), (True, VERMILLION, 2.0)):
            squares = [square for square, marked in self.frames if marked == failed]
            axes.add_collection(PolyCollection(squares, facecolors="none", edgecolors=colour, linewidths=width))
        axes.add_collection(LineCollection(self.walls, colors=INK, linewidths=1.2 * thin, zorder=1))
        axes.add_collection(PolyCollection(self.pillars, facecolors=GREY, linewidths=0, zorder=1))
        axes.add_collection(LineCollection(self.far, colors=GREY, linewidths=thin, linestyles=DASHED, zorder=3))
        for tiles, zorder, options in (
            (self.triangles, 1.5, {"linewidths": 0}),
            (self.bodies, 4, {"linewidths": 0.4 * thin, "edgecolors": "white"}),
        ):
            shapes, colours = _apart(tiles)
            axes.add_collection(PolyCollection(shapes, facecolors=colours, zorder=zorder, **options))
        for tiles, zorder, width in ((self.trails, 2, 0.9), (self.edges, 3, 1.3)):
            lines, colours = _apart(tiles)
            axes.add_collection(LineCollection(lines, colors=colours, linewidths=width * thin, zorder=zorder))


def _apart(tiles: list[tuple[FloatArray, Any]]) -> tuple[list[FloatArray], list[Any]]:
    """Return shapes and their colours in lists of their own."""
    return [shape for shape, _ in tiles], [colour for _, colour in tiles]
