"""Parts of models in MuJoCo's own format MJCF, and what may touch what."""

from __future__ import annotations

import math
from typing import NamedTuple

from triform.geometry.footprint import Footprint
from triform.simulation.arena import Arena
from triform.simulators.chassis import CENTRE_OF_MASS, HEIGHT, WALL_HEIGHT, WALL_THICKNESS, moments_of_inertia

#: What touches other bodies by MuJoCo's own bits, without friction; all else touches only what a pair names.
_SOLID = 'contype="1" conaffinity="1" condim="1"'
UNTOUCHED = 'contype="0" conaffinity="0"'


class RobotParts(NamedTuple):
    """A robot in a model.

    Attributes:
        body: The robot with all its joints.
        pairs: What touches the ground.
    """

    body: str
    pairs: str = ""


def inertia(mass: float, height: float, moments: tuple[float, float, float]) -> str:
    """Return a mass [kg] with its centre at ``height`` [m] and moments about its axes [kg m^2]."""
    return f'<inertial pos="0 0 {height}" mass="{mass}" diaginertia="{moments[0]} {moments[1]} {moments[2]}"/>'


def chassis(index: int, footprint: Footprint, mass: float, clearance: float) -> str:
    """Return the mass and the solid body of a robot, which hangs ``clearance`` [m] above the ground."""
    height = HEIGHT - clearance
    outline = (
        _capsule(footprint.half_length, height)
        if footprint.is_circle
        else _box(footprint.length, footprint.width, height)
    )
    return f"""{inertia(mass, CENTRE_OF_MASS, moments_of_inertia(footprint, mass))}
      <geom name="chassis{index}" {outline} pos="0 0 {clearance + height / 2}" {_SOLID} material="robot"/>"""


def write_arena(arena: Arena) -> str:
    """Return a body of walls, which become boxes ``WALL_THICKNESS`` thick, and pillars."""
    obstacles = []
    for x1, y1, x2, y2 in arena.walls.tolist():
        place = ((x1 + x2) / 2, (y1 + y2) / 2, math.atan2(y2 - y1, x2 - x1))
        obstacles.append(_obstacle(place, _box(math.hypot(x2 - x1, y2 - y1), WALL_THICKNESS, WALL_HEIGHT)))
    for x, y, radius in arena.pillars.tolist():
        obstacles.append(_obstacle((x, y, 0.0), _capsule(radius, WALL_HEIGHT)))
    return f'<body name="arena">{"".join(obstacles)}</body>'


def _box(length: float, width: float, height: float) -> str:
    return f'type="box" size="{length / 2} {width / 2} {height / 2}"'


def _capsule(radius: float, height: float) -> str:
    """Return an upright cylinder with a half sphere on either end.

    MuJoCo knows contacts of capsules by formula; those of cylinders with boxes are often missed by centimetres.
    """
    return f'type="capsule" size="{radius} {height / 2}"'


def _obstacle(place: tuple[float, float, float], shape: str) -> str:
    x, y, heading = place
    return f'<geom {shape} pos="{x} {y} {WALL_HEIGHT / 2}" euler="0 0 {heading}" {_SOLID} material="obstacle"/>'
