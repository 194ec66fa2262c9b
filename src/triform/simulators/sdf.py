"""Parts of worlds in SDF, Gazebo's own format: poses, shapes, inertia, and the shapes of arenas and robots."""

from __future__ import annotations

import math
from collections.abc import Iterator

from triform.geometry.footprint import Footprint
from triform.simulation.arena import Arena
from triform.simulators.chassis import WALL_HEIGHT, WALL_THICKNESS


def pose(x: float, y: float, z: float, heading: float = 0.0) -> str:
    """Return a pose [m, m, m, rad]."""
    return f"<pose>{x} {y} {z} 0 0 {heading}</pose>"


def box(length: float, width: float, height: float) -> str:
    """Return a box by its sides along x, y and z [m]."""
    return f"<box><size>{length} {width} {height}</size></box>"


def cylinder(radius: float, length: float) -> str:
    """Return a cylinder along z [m]."""
    return f"<cylinder><radius>{radius}</radius><length>{length}</length></cylinder>"


def outline(footprint: Footprint, height: float) -> str:
    """Return a robot's outline, ``height`` high [m]."""
    if footprint.is_circle:
        return cylinder(footprint.half_length, height)
    return box(footprint.length, footprint.width, height)


def obstacles(arena: Arena) -> Iterator[tuple[str, tuple[float, float, float], str]]:
    """Yield name, place (x, y, heading) [m, m, rad] and shape of each wall, a thin box, and of each pillar."""
    for index, (x1, y1, x2, y2) in enumerate(arena.walls.tolist()):
        place = ((x1 + x2) / 2, (y1 + y2) / 2, math.atan2(y2 - y1, x2 - x1))
        yield f"wall{index}", place, box(math.hypot(x2 - x1, y2 - y1), WALL_THICKNESS, WALL_HEIGHT)
    for index, (x, y, radius) in enumerate(arena.pillars.tolist()):
        yield f"pillar{index}", (x, y, 0.0), cylinder(radius, WALL_HEIGHT)


def inertia(mass: float, height: float, moments: tuple[float, float, float]) -> str:
    """Return a mass [kg] with its centre at ``height`` [m] and moments about its axes [kg m^2]."""
    ixx, iyy, izz = moments
    return f"""<inertial>{pose(0.0, 0.0, height)}<mass>{mass}</mass>
      <inertia>
        <ixx>{ixx}</ixx><iyy>{iyy}</iyy><izz>{izz}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>
      </inertia>
    </inertial>"""
