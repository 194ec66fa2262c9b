"""The place robots move in: walls and pillars, which LiDARs see and robots can run into."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from triform.simulation.intensity import Brightness
from triform.types import FloatArray, as_array, choose, convert_fields, converted, require


@dataclass(frozen=True, eq=False)
class Arena:
    """Walls and pillars in the world frame.

    Attributes:
        name: Name, recorded with results.
        walls: Segments x1, y1, x2, y2 without thickness, shape (W, 4) [m].
        pillars: Solid circles x, y, radius, shape (K, 3) [m].
        wall_intensities: How bright LiDARs see each wall, in their own scale, shape (W,); ``NaN`` is as they see most
            obstacles, and so is each of them with shape (0,).
        pillar_intensities: The same of each pillar, shape (K,) or (0,).
    """

    name: str = "open"
    walls: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    pillars: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    wall_intensities: FloatArray = field(default_factory=lambda: np.zeros(0))
    pillar_intensities: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        convert_fields(self)
        for name, columns in (("walls", 4), ("pillars", 3)):
            values = np.array(as_array(name, getattr(self, name)))
            require(
                values.ndim == 2 and values.shape[1] == columns and bool(np.isfinite(values).all()),
                f"{name} of shape {values.shape} given; a table of {columns} finite columns is needed",
            )
            object.__setattr__(self, name, values)
            self._check_intensities(f"{name[:-1]}_intensities", len(values))
        lengths = np.hypot(self.walls[:, 2] - self.walls[:, 0], self.walls[:, 3] - self.walls[:, 1])
        require(bool((lengths > 0).all()), "a wall has no length; its two ends must differ")
        require(bool((self.pillars[:, 2] > 0).all()), "the radius of a circle must be positive")

    def _check_intensities(self, name: str, obstacles: int) -> None:
        """Refuse intensities of obstacles of a kind that are not one for each."""
        values = np.array(as_array(name, getattr(self, name)))
        require(
            values.shape in ((0,), (obstacles,)),
            f"{name} of shape {values.shape} given; one for each of {obstacles} is needed",
        )
        wrong = values[~(np.isnan(values) | ((values >= 0) & (values < np.inf)))]
        require(
            wrong.size == 0,
            f"one of {name} is {wrong[:1].sum():g}; it must be finite and not negative",
        )
        object.__setattr__(self, name, values)

    def levels(self, brightness: Brightness) -> FloatArray:
        """Return how bright a LiDAR sees what rays hit, by what ``cast_moving`` says of hits, shape (W + K + 2,).

        The last value, which -1 means too, is ``NaN``, that of nothing.
        """
        kinds = ((self.walls, self.wall_intensities), (self.pillars, self.pillar_intensities))
        obstacles = np.concatenate([levels if levels.size else np.full(len(rows), np.nan) for rows, levels in kinds])
        usual = np.where(np.isnan(obstacles), brightness.obstacle, obstacles)
        return np.concatenate([usual, [brightness.robot, np.nan]])

    @classmethod
    def open(cls) -> Arena:
        """Return a plane without anything in it."""
        return cls()

    @classmethod
    def room(cls, width: float, height: float, center: tuple[float, float] = (0.0, 0.0), name: str = "room") -> Arena:
        """Return a rectangular room, ``width`` along x times ``height`` along y [m], around ``center``.

        Raises:
            ConfigurationError: If a side is not positive.
        """
        sides = converted("width", width, float), converted("height", height, float)
        require(min(sides) > 0, f"a room of {width} m x {height} m; both sides must be positive")
        left, right = center[0] - width / 2, center[0] + width / 2
        low, high = center[1] - height / 2, center[1] + height / 2
        return cls(name, walls_around(np.array([[left, low], [right, low], [right, high], [left, high]])))


def walls_around(corners: FloatArray) -> FloatArray:
    """Return the walls of a polygon, shape (K, 4), from its corners (x, y), shape (K, 2) [m]."""
    return np.concatenate([corners, np.roll(corners, -1, axis=0)], axis=1)


def box_walls(center: ArrayLike, length: float, width: float, heading: float = 0.0) -> FloatArray:
    """Return the walls of a box, shape (4, 4) [m].

    Args:
        center: Its centre x, y [m].
        length: Along its own x axis [m].
        width: Along its own y axis [m].
        heading: Of its x axis [rad].
    """
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length / 2, width / 2]
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    return walls_around(corners @ turn + np.asarray(center, dtype=np.float64))


def _legs(center: tuple[float, float], length: float, width: float, radius: float) -> list[list[float]]:
    """Return four legs as circles x, y, radius [m], whose centres are the corners of a box."""
    x, y = center
    return [[x + a * length / 2, y + b * width / 2, radius] for a in (1, -1) for b in (1, -1)]


def _living_room() -> Arena:
    """Return a living room of 9.9 m x 7.1 m with furniture of usual sizes around a free square of 5.4 m.

    At the height of a LiDAR tables and chairs are their legs, and sofa, armchair, shelves and plant pots are solid.
    """
    room = walls_around(np.array([[-4.9, -3.45], [5.0, -3.45], [5.0, 3.65], [-4.9, 3.65]]))
    sofa, armchair = box_walls((-4.45, 0.3), 0.9, 2.1), box_walls((-3.8, -2.3), 0.8, 0.8, 0.6)
    sideboard, bookshelf = box_walls((0.2, 3.425), 1.8, 0.45), box_walls((1.0, -3.3), 0.8, 0.3)
    circles = [[-3.3, 3.1, 0.2], [3.2, 3.0, 0.17], [-3.0, -3.1, 0.02]]
    circles += _legs((-3.3, 0.3), 0.5, 1.0, 0.025)
    circles += _legs((3.75, -0.4), 0.8, 1.5, 0.035)
    for x in (3.05, 4.45):
        for y in (-0.8, 0.05):
            circles += _legs((x, y), 0.4, 0.4, 0.02)
    return Arena("living-room", np.concatenate([room, sofa, armchair, sideboard, bookshelf]), np.array(circles))


#: Arenas by name. The start square of the protocol, 5 m wide around the origin, fits into each.
ARENAS = {
    arena.name: arena
    for arena in (
        Arena.open(),
        Arena.room(6.0, 6.0, name="room-6"),
        Arena(
            "pillars",
            Arena.room(8.0, 8.0).walls,
            np.array([[3.0, 3.0, 0.2], [-3.0, 3.0, 0.2], [-3.0, -3.0, 0.2], [3.0, -3.0, 0.2]]),
        ),
        _living_room(),
    )
}


def get_arena(name: str) -> Arena:
    """Return an arena by its name, or from a TOML file.

    Args:
        name: One of ``ARENAS``, or the path of a file that ends in ``.toml``.

    Raises:
        ConfigurationError: There is no such arena, or the file holds what is not allowed.
    """
    name = converted("arena", name, str)
    if name.endswith(".toml"):
        from triform.simulation.arena_file import read_arena

        return read_arena(Path(name))
    return choose("arena", name, ARENAS, " and your own as FILE.toml")
