"""Meshes of robots, walls and pillars."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from triform.figures.style import outline
from triform.simulation import Arena, Drive, Footprint
from triform.types import FloatArray, IntArray

#: Heights [m].
ROBOT_HEIGHT = 0.12
_WALL_HEIGHT = 0.3
_CLEARANCE = 0.02
_WALL_THICKNESS = 0.04
#: Sides of a pillar.
_SIDES = 32
#: Radius of a mecanum wheel over the length of a robot.
_WHEEL = 0.14


class Mesh(NamedTuple):
    """Triangles in space.

    Attributes:
        vertices: Corners [m], shape (V, 3).
        faces: Triangles as indices of their corners, counter-clockwise seen from outside, shape (F, 3).
    """

    vertices: FloatArray
    faces: IntArray

    @classmethod
    def together(cls, parts: list[Mesh]) -> Mesh:
        """Return several meshes as one."""
        firsts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        return cls(
            np.concatenate([part.vertices for part in parts]),
            np.concatenate([part.faces + first for part, first in zip(parts, firsts, strict=False)]),
        )


def prism(corners: FloatArray, low: float, high: float) -> Mesh:
    """Return what stands on a convex outline (K, 2), counter-clockwise, from one height to another [m].

    Sides and top have corners of their own, so that edges look sharp.
    """
    sides = len(corners)
    after = np.roll(np.arange(sides), -1)
    vertices, faces = [], []
    for height, order in ((high, 1), (low, -1)):
        vertices.append(np.column_stack([corners, np.full(sides, height)]))
        fan = np.column_stack([np.zeros(sides - 2), np.arange(1, sides - 1), np.arange(2, sides)])
        faces.append(fan[:, ::order] + sum(map(len, vertices[:-1])))
    for first, second in zip(corners, corners[after], strict=True):
        base = sum(map(len, vertices))
        vertices.append(np.array([[*first, low], [*second, low], [*second, high], [*first, high]]))
        faces.append(np.array([[0, 1, 2], [0, 2, 3]]) + base)
    return Mesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int64))


def _box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Mesh:
    corners = np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]])
    return prism(corners, *z)


def body_mesh(footprint: Footprint) -> Mesh:
    """Return the body of a robot."""
    return prism(outline(footprint), _CLEARANCE, ROBOT_HEIGHT)


def heading_mesh(footprint: Footprint) -> Mesh:
    """Return the mark on a robot from its centre to its front."""
    half = 0.09 * min(footprint.length, footprint.width)
    return _box((0.0, footprint.half_length), (-half, half), (ROBOT_HEIGHT, ROBOT_HEIGHT + 0.006))


def wheels_mesh(footprint: Footprint, drive: Drive) -> Mesh:
    """Return the wheels of a robot: two on an axle of a differential base, otherwise four at its corners."""
    radius = min(_WHEEL * footprint.length, 0.8 * ROBOT_HEIGHT / 2)
    width = 0.12 * footprint.width
    if drive.is_differential:
        places = [(0.0, side * 0.8 * footprint.half_width) for side in (1, -1)]
    else:
        share = 0.62 if footprint.is_circle else 0.66
        out = 0.62 if footprint.is_circle else 1.0
        places = [
            (end * share * footprint.half_length, side * out * footprint.half_width)
            for end in (1, -1)
            for side in (1, -1)
        ]
    return Mesh.together(
        [_box((x - radius, x + radius), (y - width / 2, y + width / 2), (0.0, 2 * radius)) for x, y in places]
    )


def arena_mesh(arena: Arena) -> Mesh | None:
    """Return walls and pillars; ``None`` if there are none."""
    parts = []
    for x1, y1, x2, y2 in arena.walls:
        along = np.array([x2 - x1, y2 - y1]) / np.hypot(x2 - x1, y2 - y1) * _WALL_THICKNESS / 2
        left = np.array([-along[1], along[0]])
        begin, end = np.array([x1, y1]) - along, np.array([x2, y2]) + along
        parts.append(prism(np.array([begin - left, end - left, end + left, begin + left]), 0.0, _WALL_HEIGHT))
    angle = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
    for x, y, radius in arena.pillars:
        circle = np.array([x, y]) + radius * np.column_stack([np.cos(angle), np.sin(angle)])
        parts.append(prism(circle, 0.0, _WALL_HEIGHT))
    return Mesh.together(parts) if parts else None
