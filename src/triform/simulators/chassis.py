"""What simulators of physics agree on: a RoboMaster EP under the footprint of its profile, and walls with a body."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from triform.geometry.footprint import Footprint
from triform.simulation.profiles import Drive, Profile
from triform.types import require

#: How a robot moves: by a force in the plane, on four mecanum wheels, or on two driven wheels and casters.
Base = Literal["planar", "mecanum", "differential"]
BASES: tuple[Base, ...] = ("planar", "mecanum", "differential")

#: RoboMaster EP: mass of the whole robot [kg] and height [m].
MASS = 3.4
HEIGHT = 0.27
#: RoboMaster EP: wheels stand this far in front of and beside the centre [m].
WHEEL_PLACE = 0.10
WHEEL_MASS = 0.1
CENTRE_OF_MASS = 0.08
#: Differential robots: half the width of a driven wheel, and the radius of a caster's ball [m].
WHEEL_HALF_WIDTH = 0.009
BALL_RADIUS = 0.01
#: The balls stand before and behind the axle at this share of the footprint's half length, about as those of a Create 3
#: (0.73) and of a TurtleBot3 Burger (0.65).
CASTER_PLACE = 0.7
#: Height of the LiDAR, above the wheels [m].
LIDAR_HEIGHT = 0.20
#: What a drive without limits of its own can do [m/s^2, rad/s^2]: an assumption, because real wheels slip.
MAX_ACCELERATION = 2.0
MAX_TURN_ACCELERATION = 10.0
#: A wall of an arena is a line; a simulator needs a body [m].
WALL_THICKNESS = 0.001
WALL_HEIGHT = 0.5
#: Radius of a differential base's smallest wheels [m]; smaller ones turn too fast for a step of the physics.
_SMALLEST_RADIUS = 0.01


def braked(drive: Drive) -> Drive:
    """Return a drive with the accelerations that robots with a mass are held to."""
    return replace(
        drive,
        max_acceleration=min(drive.max_acceleration, MAX_ACCELERATION),
        max_turn_acceleration=min(drive.max_turn_acceleration, MAX_TURN_ACCELERATION),
    )


def moments_of_inertia(footprint: Footprint, mass: float) -> tuple[float, float, float]:
    """Return the moments of a body of ``mass`` [kg] and ``HEIGHT`` about its axes x, y and z [kg m^2]."""
    across, along = (mass * (size**2 + HEIGHT**2) / 12 for size in (footprint.width, footprint.length))
    turning = mass * (footprint.length**2 + footprint.width**2) / (8 * 2 if footprint.is_circle else 12)
    return across, along, turning


def check_base(base: Base, profile: Profile) -> None:
    """Make sure that robots of a profile can stand on a base: on its own wheels, or on none.

    Raises:
        ConfigurationError: They cannot.
    """
    own = "differential" if profile.drive.is_differential else "mecanum"
    require(
        base in ("planar", own),
        f"base is {base!r}, but robots of the {profile.drive.kind} profile {profile.name!r} drive on a planar or a "
        f"{own} base",
    )


def check_axle(profile: Profile) -> None:
    """Make sure that the two wheels of a differential profile fit under its footprint and its chassis.

    Raises:
        ConfigurationError: They do not, or their distance is not known.
    """
    track, width = profile.drive.track, profile.footprint.width
    require(
        0 < track < width,
        f"track is {track} m; the wheels of a differential base need a distance, and a place under their footprint, "
        f"which is {width} m wide",
    )
    radius = profile.drive.wheel_radius
    require(
        _SMALLEST_RADIUS <= radius < LIDAR_HEIGHT,
        f"wheel_radius is {radius} m; in a simulator with wheels it is at least {_SMALLEST_RADIUS} m, and less than "
        f"the {LIDAR_HEIGHT} m at which LiDARs see the chassis above the wheels",
    )


def check_wheels(footprint: Footprint) -> None:
    """Make sure that mecanum wheels fit under a footprint.

    Raises:
        ConfigurationError: They do not.
    """
    require(
        min(footprint.length, footprint.width) > 2 * WHEEL_PLACE,
        f"a footprint of {footprint.length} m x {footprint.width} m is too small for mecanum wheels "
        f"{2 * WHEEL_PLACE} m apart; use the planar base",
    )
