"""An arena as a TOML file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from triform.simulation.arena import Arena, box_walls
from triform.simulation.tables import TomlTable, are_numbers, quoted
from triform.types import ConfigurationError, FloatArray


def read_arena(path: Path) -> Arena:
    """Read an arena of walls, circles and boxes.

    Raises:
        ConfigurationError: The file cannot be read, or a key or value is not allowed; the sentence names both.
    """
    top = TomlTable.read(path)
    top.known("name", "walls", "circles", "boxes")
    walls = top.rows("walls", 4, "x1, y1, x2, y2 [m], and an intensity if you like", spare=1)
    circles = top.rows("circles", 3, "x, y, radius [m], and an intensity if you like", spare=1)
    for box in top.tables("boxes", "[{ center = [1, 2], length = 2.0, width = 1.0 }]"):
        level = [box.number("intensity", 0.0)] if "intensity" in box.values else []
        walls += [side + level for side in _sides(box).tolist()]
    places = [np.array([row[:size] for row in rows]).reshape(-1, size) for rows, size in ((walls, 4), (circles, 3))]
    levels = [[(*row, np.nan)[size] for row in rows] for rows, size in ((walls, 4), (circles, 3))]
    try:
        return Arena(top.text("name", path.stem), *places, *(np.array(each) for each in levels))
    except ConfigurationError as error:
        raise top.refused(error) from None


def _sides(box: TomlTable) -> FloatArray:
    """Return the four walls of a box, shape (4, 4) [m]."""
    box.known("center", "length", "width", "heading", "intensity")
    center = box.values.get("center")
    if not are_numbers(center, 2):
        raise box.wrong("center", center, "two numbers are needed: x, y [m]")
    length, width, heading = box.number("length", 0.0), box.number("width", 0.0), box.number("heading", 0.0)
    for key, value in (("length", length), ("width", width)):
        if not 0 < value < np.inf:
            raise box.wrong(key, value, "it must be positive and finite [m]")
    if not np.isfinite(heading):
        raise box.wrong("heading", heading, "it must be finite [rad]")
    return box_walls(np.asarray(center, dtype=np.float64), length, width, heading)


def arena_toml(arena: Arena) -> str:
    """Return an arena as the text of a TOML file, with units, to start from."""
    lines = [
        f"name = {quoted(arena.name)}",
        "# Segments x1, y1, x2, y2 [m], and how bright LiDARs see one, in their own scale, if not as most obstacles.",
        f"walls = {_rows(arena.walls, arena.wall_intensities)}",
        "# Solid circles x, y, radius [m], and the same.",
        f"circles = {_rows(arena.pillars, arena.pillar_intensities)}",
        "# A box is four walls: [[boxes]] with center = [x, y], length, width [m], heading [rad] and intensity.",
    ]
    return "\n".join(lines) + "\n"


def _rows(table: FloatArray, intensities: FloatArray) -> str:
    levels = [[] if np.isnan(level) else [level] for level in intensities.tolist()] or [[]] * len(table)
    rows = ",\n".join(f"    {row + level}" for row, level in zip(table.tolist(), levels, strict=True))
    return f"[\n{rows},\n]" if rows else "[]"
