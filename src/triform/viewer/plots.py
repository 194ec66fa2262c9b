"""Plots that follow a run, and pictures of numbers, as viser's panel shows them."""

from __future__ import annotations

import html

import numpy as np
import viser
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from viser import uplot

from triform.evaluation.metrics import TOLERANCE
from triform.figures.style import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, VERMILLION, Colours, map_colours
from triform.types import FloatArray
from triform.viewer.formation import Course, Formation
from triform.viewer.reading import Reading
from triform.viewer.sensing import Sensing

_HEIGHT = 118
#: Pixels along a side of a cell of a map.
_CELL = 4
_GRID: uplot.Axis = {"stroke": INK, "grid": {"stroke": "#ececec", "width": 1}, "size": 30, "font": "11px sans-serif"}
_DASH = (6.0, 4.0)
_FONT = ImageFont.load_default(size=26)


class Plots:
    """Formation error with its 10 % line, lengths of edges and compactness, over time."""

    def __init__(self, gui: viser.GuiApi, distance: float) -> None:
        """Add empty plots to the part of the panel that is open."""
        limit = f"{100 * TOLERANCE:g} %"
        self._error = _plot(
            gui,
            "formation error [%], green where strict",
            {"label": "strict", "fill": "rgba(0, 158, 115, 0.25)", "width": 0, "points": {"show": False}},
            {"label": limit, "stroke": GREEN, "width": 1, "dash": _DASH},
            {"label": "error [%]", "stroke": BLUE, "width": 2},
        )
        self._lengths = _plot(
            gui,
            "edges: shortest, median, longest [m]",
            {"label": "d*", "stroke": GREEN, "width": 1, "dash": _DASH},
            {"label": "longest", "stroke": VERMILLION, "width": 1},
            {"label": "median", "stroke": INK, "width": 2},
            {"label": "shortest", "stroke": BLUE, "width": 1},
        )
        self._compactness = _plot(
            gui,
            "compactness",
            {"label": "most", "stroke": GREEN, "width": 1, "dash": _DASH},
            {"label": "compactness", "stroke": PURPLE, "width": 2},
        )
        self.distance = distance

    def show(self, course: Course) -> None:
        """Show how a run went."""
        known = np.isfinite(course.error)
        time, error, strict, shortest, median, longest, compactness = (values[known] for values in course)
        if len(time) < 2:
            return
        limit, same = 100 * TOLERANCE, np.ones(len(time))
        self._error.data = (time, limit * strict, limit * same, 100 * error)
        self._lengths.data = (time, self.distance * same, longest, median, shortest)
        self._compactness.data = (time, same, compactness)


def _plot(gui: viser.GuiApi, title: str, *series: uplot.Series) -> viser.GuiUplotHandle:
    """Add an empty plot over time."""
    empty = np.zeros(1)
    return gui.add_uplot(
        (empty,) * (len(series) + 1),
        ({"label": "s"}, *series),
        title=title,
        scales={"x": {"time": False}},
        axes=(_GRID, _GRID),
        legend={"show": False},
        height=_HEIGHT,
    )


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
    """Return the command of a robot, and what it rests on."""
    wanted, command = sensing.wanted, sensing.command
    lines = [f"{len(sensing.hits)} returns within {sensing.reach:g} m", f"wants {_velocity(wanted)}"]
    if np.allclose(wanted, command, atol=1e-3):
        lines.append("and gets it")
    else:
        lines.append(f'<span style="color:{VERMILLION}">gets {_velocity(command)}</span>')
    return _block(f"<b>Robot {robot}</b>: {'; '.join(lines)}.")


def map_html(reading: Reading) -> str:
    """Return what the marks on a map mean."""
    groups = reading.groups
    if groups is None:
        return _block("The map that the default policy would see.")
    if reading.attention is None:
        return _block("Numbers: cm/s by which the command changes without the group.")
    return _block(
        f"{_swatch(BLUE, 'attention')} {_swatch(PURPLE, f'taken for a neighbour ({groups.neighbours.sum()})')}<br>"
        "Numbers: cm/s by which the command changes without the group."
    )


def _velocity(twist: FloatArray) -> str:
    forward, left, turn = twist
    turning = f", {turn:+.2f} rad/s" if abs(turn) > 5e-3 else ""
    return f"{forward:+.2f} m/s forward, {left:+.2f} left{turning}"


def text_html(text: str) -> str:
    """Return a text as it is."""
    return _block(html.escape(text))


def map_image(reading: Reading, colour: Colours) -> NDArray[np.uint8]:
    """Return a robot's occupancy map with forward up and left left, uint8, shape (4 H, 4 W, 3).

    Grey lines are the patches of the network; those that hold something are blue, the darker the more attention they
    get, and the network sees nothing else. Rings are around groups of cells, thick ones around what the network takes
    for neighbours, with the cm/s by which the command changes without the group.
    """
    size, patch = len(reading.occupancy), reading.patch
    image = map_colours(reading.occupancy, patch, reading.attention)
    image = np.kron(image, np.ones((_CELL, _CELL, 1), dtype=np.uint8))
    for place in size * _CELL - 1 - np.arange(patch, size, patch) * _CELL:
        image[place], image[:, place] = np.minimum(image[place], 228), np.minimum(image[:, place], 228)
    drawn = Image.fromarray(image)
    canvas, middle = ImageDraw.Draw(drawn), size * _CELL / 2

    def spot(point: FloatArray) -> tuple[float, float]:
        return middle - point[1] / reading.cell * _CELL, middle - point[0] / reading.cell * _CELL

    own = tuple(colour.tolist())
    canvas.rectangle((middle - 9, middle - 9, middle + 9, middle + 9), fill=own)
    canvas.line((middle, middle, middle, middle - 20), fill=own, width=5)
    groups = reading.groups
    for group in range(0 if groups is None else len(groups.changes)):
        assert groups is not None
        centre = np.array(spot(groups.centres[group]))
        radius = groups.radii[group] / reading.cell * _CELL + 14
        ring, width = (PURPLE, 7) if groups.neighbours[group] else (GREY, 2)
        canvas.ellipse((*(centre - radius), *(centre + radius)), outline=ring, width=width)
        # Outside the ring, on the side away from the robot.
        away = (centre - middle) / max(float(np.linalg.norm(centre - middle)), 1.0)
        x, y = centre + (radius + 20) * away
        change = f"{100 * groups.changes[group]:.0f}"
        canvas.text((x, y), change, INK, _FONT, anchor="mm", stroke_width=3, stroke_fill="#ffffff")
    return np.asarray(drawn)


def _swatch(colour: str, label: str) -> str:
    return (
        f'<span style="white-space:nowrap;margin-right:8px"><span style="display:inline-block;width:12px;height:12px;'
        f'background:{colour};margin-right:4px;vertical-align:-1px;border-radius:2px"></span>{label}</span>'
    )


def _badge(text: str, colour: str) -> str:
    return f'<span style="background:{colour};color:white;border-radius:8px;padding:0 8px;font-size:85%">{text}</span>'


def _block(inner: str) -> str:
    return f'<div style="padding:2px 12px;font-size:13px;line-height:1.5">{inner}</div>'
