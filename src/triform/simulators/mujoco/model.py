"""Writes the models of a team in MuJoCo's own format MJCF: one that moves, and one that LiDARs see."""

from __future__ import annotations

from triform.geometry.footprint import Footprint
from triform.simulation.arena import Arena
from triform.simulation.profiles import Profile
from triform.simulators.chassis import Base
from triform.simulators.mujoco.differential import DifferentialBase
from triform.simulators.mujoco.mecanum import MecanumBase
from triform.simulators.mujoco.planar import PlanarBase
from triform.simulators.mujoco.shapes import UNTOUCHED, chassis, write_arena

#: What moves robots, for each base.
MOTIONS: dict[Base, type[PlanarBase] | type[MecanumBase] | type[DifferentialBase]] = {
    "planar": PlanarBase,
    "mecanum": MecanumBase,
    "differential": DifferentialBase,
}

#: Rubber on the ground. Stiffer than MuJoCo's own values, with which wheels sink in by 0.7 mm and lose 3 % of a speed.
_GRIP = 'condim="3" friction="1 1 0 0 0" solref="0.01 1" solimp="0.95 0.99 0.001"'
#: What pictures need.
_LOOKS = """<visual>
      <global offwidth="1920" offheight="1080"/><headlight ambient="0.4 0.4 0.4" diffuse="0.5 0.5 0.5"/>
    </visual>
    <asset>
      <texture name="tiles" type="2d" builtin="checker" width="64" height="64" rgb1="0.9 0.9 0.9" rgb2="0.8 0.8 0.8"/>
      <material name="ground" texture="tiles" texuniform="true" texrepeat="1 1"/>
      <material name="robot" rgba="0 0.45 0.7 1"/><material name="tyre" rgba="0.2 0.2 0.2 1"/>
      <material name="obstacle" rgba="0.5 0.5 0.5 1"/>
    </asset>"""


def write_model(profile: Profile, arena: Arena, robots: int, base: Base) -> str:
    """Return a model of a ground, an arena and robots, each with two sensors: of contacts with all, and the arena.

    Args:
        profile: Kind of all robots.
        arena: Walls and pillars.
        robots: Number of robots.
        base: How the robots move.

    Raises:
        ConfigurationError: The base does not fit under the footprint.
    """
    motion = MOTIONS[base]
    parts = [motion.write_robot(index, profile) for index in range(robots)]
    sensors = "".join(
        f'<contact geom1="chassis{index}" data="found"/><contact geom1="chassis{index}" body2="arena" data="found"/>'
        for index in range(robots)
    )
    return f"""<mujoco model="triform">
    <compiler angle="radian"/>
    <option timestep="{motion.time_step}" integrator="implicitfast" cone="elliptic"/>
    <default><pair {_GRIP}/></default>
    {_LOOKS}
    <worldbody>
      <geom name="ground" type="plane" size="0 0 1" {UNTOUCHED} material="ground"/>
      {write_arena(arena)}
      {"".join(part.body for part in parts)}
    </worldbody>
    <contact>{"".join(part.pairs for part in parts)}</contact>
    <sensor>{sensors}</sensor>
    </mujoco>"""


def write_sight(footprint: Footprint, arena: Arena, robots: int) -> str:
    """Return a model of what rays meet: an arena, and robots without wheels that are put where they are."""
    bodies = "".join(
        f'<body name="robot{index}" mocap="true">{chassis(index, footprint, 1.0, 0.0)}</body>'
        for index in range(robots)
    )
    return f"""<mujoco model="sight">
    <compiler angle="radian"/>{_LOOKS}
    <worldbody>{write_arena(arena)}{"".join(bodies)}</worldbody>
    </mujoco>"""
