"""Writes the world that Gazebo simulates, in its own format SDF."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal
from xml.etree.ElementTree import Element, SubElement, tostring

from triform.simulation.arena import Arena
from triform.simulation.kinematics import WHEEL_RADIUS
from triform.simulation.profiles import Drive, Footprint, Profile
from triform.types import require

#: How a base moves: a force in the plane, or four mecanum wheels.
GazeboBase = Literal["planar", "mecanum"]

#: RoboMaster EP: mass of the whole robot [kg] and height [m].
MASS = 3.4
HEIGHT = 0.27
#: RoboMaster EP: wheels stand so far in front of and beside the centre [m].
_WHEEL_PLACE = 0.10
_WHEEL_MASS = 0.1
_CENTRE_OF_MASS = 0.08
#: Height of the LiDAR, above the wheels [m].
_LIDAR_HEIGHT = 0.20
#: What a drive without limits of its own can do [m/s^2, rad/s^2]: an assumption, because real wheels slip.
MAX_ACCELERATION = 2.0
MAX_TURN_ACCELERATION = 10.0
#: A wall of an arena is a line; Gazebo needs a body [m].
WALL_THICKNESS = 0.001
_WALL_HEIGHT = 0.5
#: Bits of what may touch what: wheels touch the ground alone.
_BODY, _WHEEL = 1, 2


def braked(drive: Drive) -> Drive:
    """Return a drive with the accelerations that Gazebo's robots are held to."""
    return replace(
        drive,
        max_acceleration=min(drive.max_acceleration, MAX_ACCELERATION),
        max_turn_acceleration=min(drive.max_turn_acceleration, MAX_TURN_ACCELERATION),
    )


def write_world(profile: Profile, arena: Arena, robots: int, base: GazeboBase, time_step: float, plugin: str) -> str:
    """Return an SDF world with a ground, an arena and robots that wait to be placed.

    Args:
        profile: Kind of all robots.
        arena: Walls, which become boxes ``WALL_THICKNESS`` thick, and pillars.
        robots: Number of robots, spare ones included.
        base: How the robots move.
        time_step: Step of the physics [s].
        plugin: Path of the lock-step plugin as Gazebo sees it.
    """
    root = Element("sdf", version="1.6")
    world = SubElement(root, "world", name="triform")
    physics = SubElement(world, "physics", type="ode")
    _fill(physics, max_step_size=time_step, real_time_factor=0, real_time_update_rate=0)
    ode = SubElement(physics, "ode")
    _fill(SubElement(ode, "solver"), type="quick", iters=20)
    _fill(SubElement(ode, "constraints"), cfm=0, erp=0.2)
    scan, drive = profile.lidar.scan, braked(profile.drive)
    _fill(
        SubElement(world, "plugin", name="lockstep", filename=plugin),
        robots=robots, rays=scan.rays, angle_min=scan.angle_min, range_min=scan.range_min, range_max=scan.range_max,
        lidar_height=_LIDAR_HEIGHT, wheel_radius=WHEEL_RADIUS, lag=drive.lag,
        max_acceleration=drive.max_acceleration, max_turn_acceleration=drive.max_turn_acceleration,
    )  # fmt: skip
    _add_ground(world)
    for index, (x1, y1, x2, y2) in enumerate(arena.walls.tolist()):
        length, middle = math.hypot(x2 - x1, y2 - y1), ((x1 + x2) / 2, (y1 + y2) / 2)
        shape = _box(length, WALL_THICKNESS, _WALL_HEIGHT)
        _add_obstacle(world, f"wall{index}", (*middle, math.atan2(y2 - y1, x2 - x1)), shape)
    for index, (x, y, radius) in enumerate(arena.pillars.tolist()):
        _add_obstacle(world, f"pillar{index}", (x, y, 0.0), _cylinder(radius, _WALL_HEIGHT))
    for index in range(robots):
        _add_robot(world, index, profile.footprint, base)
    return tostring(root, encoding="unicode")


def _fill(parent: Element, /, **values: object) -> None:
    """Append one child for every value; ``repr`` keeps all bits of a number."""
    for name, value in values.items():
        SubElement(parent, name).text = value if isinstance(value, str) else repr(value)


def _pose(parent: Element, x: float, y: float, z: float, heading: float = 0.0) -> None:
    _fill(parent, pose=f"{x!r} {y!r} {z!r} 0 0 {heading!r}")


def _box(length: float, width: float, height: float) -> Element:
    box = Element("box")
    _fill(box, size=f"{length!r} {width!r} {height!r}")
    return box


def _cylinder(radius: float, length: float) -> Element:
    cylinder = Element("cylinder")
    _fill(cylinder, radius=radius, length=length)
    return cylinder


def _add_collision(link: Element, shape: Element, height: float, bits: int, friction: tuple[float, float]) -> None:
    """Append a body whose centre is at ``height`` [m], with friction along and across its first direction."""
    collision = SubElement(link, "collision", name="body")
    _pose(collision, 0.0, 0.0, height)
    SubElement(collision, "geometry").append(shape)
    surface = SubElement(collision, "surface")
    _fill(SubElement(SubElement(surface, "friction"), "ode"), mu=friction[0], mu2=friction[1], fdir1="1 0 0")
    _fill(SubElement(surface, "contact"), collide_bitmask=bits)


def _add_inertia(link: Element, mass: float, height: float, moments: tuple[float, float, float]) -> None:
    inertial = SubElement(link, "inertial")
    _pose(inertial, 0.0, 0.0, height)
    _fill(inertial, mass=mass)
    ixx, iyy, izz = moments
    _fill(SubElement(inertial, "inertia"), ixx=ixx, iyy=iyy, izz=izz, ixy=0, ixz=0, iyz=0)


def _add_static(world: Element, name: str) -> tuple[Element, Element]:
    model = SubElement(world, "model", name=name)
    _fill(model, static="true")
    return model, SubElement(model, "link", name="link")


def _add_ground(world: Element) -> None:
    _, link = _add_static(world, "ground")
    plane = Element("plane")
    _fill(plane, normal="0 0 1", size="100 100")
    _add_collision(link, plane, 0.0, _BODY | _WHEEL, (1.0, 1.0))


def _add_obstacle(world: Element, name: str, place: tuple[float, float, float], shape: Element) -> None:
    model, link = _add_static(world, name)
    x, y, heading = place
    _pose(model, x, y, _WALL_HEIGHT / 2, heading)
    _add_collision(link, shape, 0.0, _BODY, (0.0, 0.0))


def _add_robot(world: Element, index: int, footprint: Footprint, base: GazeboBase) -> None:
    """Append a robot, far below the ground until it is placed."""
    model = SubElement(world, "model", name=f"robot{index}")
    _pose(model, 0.0, 0.0, -100.0 * (index + 1))
    link = SubElement(model, "link", name="base")
    wheels = base == "mecanum"
    mass = MASS - 4 * _WHEEL_MASS if wheels else MASS
    across, along = (mass * (size**2 + HEIGHT**2) / 12 for size in (footprint.width, footprint.length))
    turning = mass * (footprint.length**2 + footprint.width**2) / (8 * 2 if footprint.is_circle else 12)
    _add_inertia(link, mass, _CENTRE_OF_MASS, (across, along, turning))
    # On wheels the body hangs clear of the ground.
    clearance = WHEEL_RADIUS if wheels else 0.0
    height = HEIGHT - clearance
    shape = (
        _cylinder(footprint.half_length, height)
        if footprint.is_circle
        else _box(footprint.length, footprint.width, height)
    )
    _add_collision(link, shape, clearance + height / 2, _BODY, (0.0, 0.0))
    if wheels:
        require(
            min(footprint.length, footprint.width) > 2 * _WHEEL_PLACE,
            f"a footprint of {footprint.length} m x {footprint.width} m is too small for mecanum wheels "
            f"{2 * _WHEEL_PLACE} m apart; use the planar drive",
        )
        for name, x, y in (("fl", 1, 1), ("fr", 1, -1), ("rl", -1, 1), ("rr", -1, -1)):
            _add_wheel(model, name, x * _WHEEL_PLACE, y * _WHEEL_PLACE)


def _add_wheel(model: Element, name: str, x: float, y: float) -> None:
    link = SubElement(model, "link", name=name)
    _pose(link, x, y, WHEEL_RADIUS)
    moment = 0.5 * _WHEEL_MASS * WHEEL_RADIUS**2
    _add_inertia(link, _WHEEL_MASS, 0.0, (moment, moment, moment))
    sphere = Element("sphere")
    _fill(sphere, radius=WHEEL_RADIUS)
    # Rollers: full friction along the first direction, which the plugin turns, none across it.
    _add_collision(link, sphere, 0.0, _WHEEL, (1.0, 0.0))
    joint = SubElement(model, "joint", name=f"{name}_axle", type="revolute")
    _fill(joint, parent="base", child=name)
    _fill(SubElement(joint, "axis"), xyz="0 1 0")
