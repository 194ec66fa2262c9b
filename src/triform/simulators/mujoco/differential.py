"""A base on two driven wheels and two ball casters."""

from __future__ import annotations

import numpy as np
from mujoco.batch import Batch

from triform.simulation.profiles import Drive, Profile
from triform.simulators.chassis import (
    BALL_RADIUS,
    CASTER_PLACE,
    MASS,
    WHEEL_HALF_WIDTH,
    WHEEL_MASS,
    check_axle,
)
from triform.simulators.mujoco.shapes import UNTOUCHED, RobotParts, chassis, inertia
from triform.simulators.mujoco.wheeled import ARMATURE, WheeledBase
from triform.types import FloatArray

#: A ball rolls in any direction: no friction. It gives way more than the wheels do, so that they carry the robot.
_BALL = 'condim="1" solref="0.04 1"'


class DifferentialBase(WheeledBase):
    """The bases of B worlds of N robots on two driven wheels, on an axle through the robot's centre."""

    #: Step of the physics [s]: two for the time in which the ground stops a wheel.
    time_step = 0.005

    def __init__(self, batch: Batch, robots: int, profile: Profile) -> None:
        """Take the simulations, and what the bases can do."""
        super().__init__(batch, robots, profile.drive, _wheel_rates(profile.drive), 1)

    @staticmethod
    def write_robot(index: int, profile: Profile) -> RobotParts:
        """Return a robot, and the wheels and balls that touch the ground.

        Raises:
            ConfigurationError: The wheels do not fit under the footprint, or their distance is not known.
        """
        footprint, drive = profile.footprint, profile.drive
        check_axle(profile)
        radius = drive.wheel_radius
        moment = 0.5 * WHEEL_MASS * radius**2
        # Treads are rounded, so that a wheel touches the ground in one point.
        wheels = "".join(
            f"""<body pos="0 {side * drive.track / 2} {radius}">
      <joint type="hinge" axis="0 1 0" armature="{ARMATURE}"/>{inertia(WHEEL_MASS, 0.0, (moment, moment, moment))}
      <geom name="{name}{index}" type="ellipsoid" size="{radius} {WHEEL_HALF_WIDTH} {radius}" {UNTOUCHED}
        material="tyre"/>
    </body>"""
            for name, side in (("left", 1), ("right", -1))
        )
        place = CASTER_PLACE * footprint.half_length
        balls = "".join(
            f'<geom name="{name}{index}" type="sphere" size="{BALL_RADIUS}" pos="{side * place} 0 {BALL_RADIUS}" '
            f'{UNTOUCHED} material="tyre"/>'
            for name, side in (("front", 1), ("rear", -1))
        )
        pairs = "".join(f'<pair geom1="ground" geom2="{name}{index}"/>' for name in ("left", "right")) + "".join(
            f'<pair geom1="ground" geom2="{name}{index}" {_BALL}/>' for name in ("front", "rear")
        )
        body = chassis(index, footprint, MASS - 2 * WHEEL_MASS, radius)
        return RobotParts(f'<body name="robot{index}"><freejoint/>{body}{balls}{wheels}</body>', pairs)


def _wheel_rates(drive: Drive) -> FloatArray:
    """Return the rates of the left and the right wheel that make a body twist, shape (2, 3) [rad/m, rad/m, 1]."""
    half = drive.track / 2
    return np.array([[1.0, 0.0, -half], [1.0, 0.0, half]]) / drive.wheel_radius
