"""Parts of worlds in SDF, Gazebo's own format: poses, shapes and inertia."""

from __future__ import annotations


def pose(x: float, y: float, z: float, heading: float = 0.0) -> str:
    """Return a pose [m, m, m, rad]."""
    return f"<pose>{x} {y} {z} 0 0 {heading}</pose>"


def box(length: float, width: float, height: float) -> str:
    """Return a box by its sides along x, y and z [m]."""
    return f"<box><size>{length} {width} {height}</size></box>"


def cylinder(radius: float, length: float) -> str:
    """Return a cylinder along z [m]."""
    return f"<cylinder><radius>{radius}</radius><length>{length}</length></cylinder>"


def inertia(mass: float, height: float, moments: tuple[float, float, float]) -> str:
    """Return a mass [kg] with its centre at ``height`` [m] and moments about its axes [kg m^2]."""
    ixx, iyy, izz = moments
    return f"""<inertial>{pose(0.0, 0.0, height)}<mass>{mass}</mass>
      <inertia>
        <ixx>{ixx}</ixx><iyy>{iyy}</iyy><izz>{izz}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>
      </inertia>
    </inertial>"""
