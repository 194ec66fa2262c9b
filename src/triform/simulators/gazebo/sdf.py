"""Writes the world that Gazebo simulates, in its own format SDF."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

from triform.geometry.footprint import Footprint
from triform.simulation.arena import Arena
from triform.simulation.kinematics import WHEEL_RADIUS
from triform.simulation.profiles import Profile
from triform.simulators.chassis import (
    CENTRE_OF_MASS,
    HEIGHT,
    LIDAR_HEIGHT,
    MASS,
    WALL_HEIGHT,
    WHEEL_MASS,
    WHEEL_PLACE,
    Base,
    braked,
    check_wheels,
    moments_of_inertia,
)
from triform.simulators.sdf import inertia, obstacles, outline, pose

#: Bits of what may touch what: wheels touch the ground alone.
_BODY, _WHEEL = 1, 2


def write_world(profile: Profile, arena: Arena, robots: int, base: Base, time_step: float, plugin: str) -> str:
    """Return an SDF world with a ground, an arena and robots that wait to be placed.

    Args:
        profile: Kind of all robots.
        arena: Walls, which become boxes ``WALL_THICKNESS`` thick, and pillars.
        robots: Number of robots, spare ones included.
        base: How the robots move.
        time_step: Step of the physics [s].
        plugin: Path of the lock-step plugin as Gazebo sees it.
    """
    scan, drive = profile.lidar.scan, braked(profile.drive)
    ground = _collision("<plane><normal>0 0 1</normal><size>100 100</size></plane>", 0.0, _BODY | _WHEEL, (1.0, 1.0))
    return f"""<sdf version="1.6"><world name="triform">
    <physics type="ode">
      <max_step_size>{time_step}</max_step_size>
      <real_time_factor>0</real_time_factor><real_time_update_rate>0</real_time_update_rate>
      <ode>
        <solver><type>quick</type><iters>20</iters></solver>
        <constraints><cfm>0</cfm><erp>0.2</erp></constraints>
      </ode>
    </physics>
    <plugin name="lockstep" filename={quoteattr(plugin)}>
      <robots>{robots}</robots><rays>{scan.rays}</rays><angle_min>{scan.angle_min}</angle_min>
      <range_min>{scan.range_min}</range_min><range_max>{scan.range_max}</range_max>
      <lidar_height>{LIDAR_HEIGHT}</lidar_height><wheel_radius>{WHEEL_RADIUS}</wheel_radius><lag>{drive.lag}</lag>
      <max_acceleration>{drive.max_acceleration}</max_acceleration>
      <max_turn_acceleration>{drive.max_turn_acceleration}</max_turn_acceleration>
    </plugin>
    <model name="ground"><static>true</static><link name="link">{ground}</link></model>
    {"".join(_obstacle(*each) for each in obstacles(arena))}
    {"".join(_robot(index, profile.footprint, base) for index in range(robots))}
    </world></sdf>"""


def _collision(shape: str, height: float, bits: int, friction: tuple[float, float]) -> str:
    """Return a body whose centre is at ``height`` [m], with friction along and across its first direction."""
    return f"""<collision name="body">
      {pose(0.0, 0.0, height)}<geometry>{shape}</geometry>
      <surface>
        <friction><ode><mu>{friction[0]}</mu><mu2>{friction[1]}</mu2><fdir1>1 0 0</fdir1></ode></friction>
        <contact><collide_bitmask>{bits}</collide_bitmask></contact>
      </surface>
    </collision>"""


def _obstacle(name: str, place: tuple[float, float, float], shape: str) -> str:
    x, y, heading = place
    return f"""<model name="{name}"><static>true</static>
      <link name="link">{_collision(shape, 0.0, _BODY, (0.0, 0.0))}</link>
      {pose(x, y, WALL_HEIGHT / 2, heading)}
    </model>"""


def _robot(index: int, footprint: Footprint, base: Base) -> str:
    """Return a robot, far below the ground until it is placed."""
    wheels = base == "mecanum"
    if wheels:
        check_wheels(footprint)
    mass = MASS - 4 * WHEEL_MASS if wheels else MASS
    # On wheels the body hangs clear of the ground.
    clearance = WHEEL_RADIUS if wheels else 0.0
    height = HEIGHT - clearance
    signs = (("fl", 1, 1), ("fr", 1, -1), ("rl", -1, 1), ("rr", -1, -1)) if wheels else ()
    return f"""<model name="robot{index}">{pose(0.0, 0.0, -100.0 * (index + 1))}
      <link name="base">
        {inertia(mass, CENTRE_OF_MASS, moments_of_inertia(footprint, mass))}
        {_collision(outline(footprint, height), clearance + height / 2, _BODY, (0.0, 0.0))}
      </link>
      {"".join(_wheel(name, x * WHEEL_PLACE, y * WHEEL_PLACE) for name, x, y in signs)}
    </model>"""


def _wheel(name: str, x: float, y: float) -> str:
    moment = 0.5 * WHEEL_MASS * WHEEL_RADIUS**2
    sphere = f"<sphere><radius>{WHEEL_RADIUS}</radius></sphere>"
    # Rollers: full friction along the first direction, which the plugin turns, none across it.
    return f"""<link name="{name}">{pose(x, y, WHEEL_RADIUS)}
      {inertia(WHEEL_MASS, 0.0, (moment, moment, moment))}
      {_collision(sphere, 0.0, _WHEEL, (1.0, 0.0))}
    </link>
    <joint name="{name}_axle" type="revolute">
      <parent>base</parent><child>{name}</child><axis><xyz>0 1 0</xyz></axis>
    </joint>"""
