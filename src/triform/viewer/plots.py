"""Plots that follow a run, and pictures of numbers, as viser's panel shows them."""

from __future__ import annotations

import html

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from triform.evaluation.metrics import TOLERANCE
from triform.figures.sensing import Sensing
from triform.figures.style import BLUE, GREEN, GREY, INK, ORANGE, VERMILLION, Colours, map_colours
from triform.viewer.formation import Course, Formation

_HEIGHT = 150
#: Pixels along a side of a cell of a map.
_CELL = 3
_GRID: uplot.Axis = {"stroke": INK, "grid": {"stroke": "#ececec", "width": 1}, "size": 34}
_DASH = (6.0, 4.0)


class Plots:
    """Formation error with its 10 % line, and lengths of edges, over time."""

    def __init__(self, gui: viser.GuiApi, distance: float) -> None:
        """Add empty plots to the part of the panel that is open."""
        empty = np.zeros(1)
        scales: dict[str, uplot.Scale] = {"x": {"time": False}}
        self._error = gui.add_uplot(
            (empty, empty, empty, empty),
            (
                {"label": "s"},
                {"label": "strict", "fill": "rgba(0, 158, 115, 0.25)", "width": 0, "points": {"show": False}},
                {"label": f"{100 * TOLERANCE:g} %", "stroke": GREEN, "width": 1, "dash": _DASH},
                {"label": "error [%]", "stroke": BLUE, "width": 2},
            ),
            title="formation error [%]",
            scales=scales,
            axes=(_GRID, _GRID),
            legend={"show": False},
            height=_HEIGHT,
        )
        self._lengths = gui.add_uplot(
            (empty, empty, empty, empty, empty),
            (
                {"label": "s"},
                {"label": "d*", "stroke": GREEN, "width": 1, "dash": _DASH},
                {"label": "longest", "stroke": VERMILLION, "width": 1},
                {"label": "median", "stroke": INK, "width": 2},
                {"label": "shortest", "stroke": BLUE, "width": 1},
            ),
            title="edges: shortest, median, longest [m]",
            scales=scales,
            axes=(_GRID, _GRID),
            legend={"show": False},
            height=_HEIGHT,
        )
        self.distance = distance

    def show(self, course: Course) -> None:
        """Show how a run went."""
        known = np.isfinite(course.error)
        time, error, strict, shortest, median, longest = (values[known] for values in course)
        if len(time) < 2:
            return
        limit = 100 * TOLERANCE
        self._error.data = (time, limit * strict, np.full(len(time), limit), 100 * error)
        self._lengths.data = (time, np.full(len(time), self.distance), longest, median, shortest)


def status_html(formation: Formation, speed: float, paused: bool) -> str:
    """Return the state of a team in one line."""
    error = "no edges" if np.isnan(formation.error) else f"<b>{100 * formation.error:.1f} %</b> formation error"
    strict = _badge("strict", GREEN) if formation.strict else _badge("not strict", GREY)
    pace = _badge("paused", ORANGE) if paused else f"&times; {speed:g}"
    compact = "" if np.isnan(formation.compactness) else f"compactness {formation.compactness:.2f}, "
    return _block(
        f'<div style="display:flex;justify-content:space-between"><span>{formation.time:.1f} s {pace}</span>{strict}'
        f"</div><div>{error}</div><div>{compact}{len(formation.robots)} robots, {len(formation.edges)} edges</div>"
    )


def legend_html() -> str:
    """Return what the colours of edges mean."""
    entries = ((BLUE, "too short"), (GREEN, "d*"), (VERMILLION, "too long"), (GREY, "over 2 d*"))
    lines = [
        f'<span style="white-space:nowrap"><span style="display:inline-block;width:16px;height:4px;background:{colour};'
        f'margin-right:4px;vertical-align:middle"></span>{label}</span>'
        for colour, label in entries
    ]
    return _block(f'<div style="display:flex;gap:10px;flex-wrap:wrap">edges {"".join(lines)}</div>')


def sensing_html(robot: int, sensing: Sensing) -> str:
    """Return the command of a robot."""
    forward, left, turn = sensing.command
    return _block(
        f"robot {robot}: {forward:+.2f} m/s forward, {left:+.2f} m/s left, {turn:+.2f} rad/s; "
        f"{len(sensing.hits)} returns within {sensing.reach:g} m"
    )


def text_html(text: str) -> str:
    """Return a text as it is."""
    return _block(html.escape(text))


def map_image(sensing: Sensing, colour: Colours) -> NDArray[np.uint8]:
    """Return a robot's occupancy map with forward up and left left, uint8, shape (H, W, 3).

    Grey lines are the patches of the network; those that hold something are blue, and the network sees nothing else.
    """
    occupancy = sensing.occupancy
    assert occupancy is not None
    size, patch = len(occupancy), sensing.patch
    image = np.kron(map_colours(occupancy, patch), np.ones((_CELL, _CELL, 1), dtype=np.uint8))
    if patch:
        lines = size * _CELL - 1 - np.arange(patch, size, patch) * _CELL
        for place in lines:
            image[place], image[:, place] = np.minimum(image[place], 225), np.minimum(image[:, place], 225)
    centre, half = size * _CELL // 2, 2 * _CELL
    image[centre - half : centre + half, centre - half : centre + half] = colour
    image[centre - 4 * _CELL : centre - half, centre - 1 : centre + 1] = colour
    return image


def _badge(text: str, colour: str) -> str:
    return f'<span style="background:{colour};color:white;border-radius:8px;padding:0 8px;font-size:85%">{text}</span>'


def _block(inner: str) -> str:
    return f'<div style="padding:2px 12px;font-size:13px;line-height:1.5">{inner}</div>'
