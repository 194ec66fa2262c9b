"""A base on four mecanum wheels, each with rollers that turn by themselves."""

from __future__ import annotations

import math

import numpy as np
from mujoco.batch import Batch

from triform.simulation.kinematics import WHEEL_RADIUS
from triform.simulation.profiles import Profile
from triform.simulators.chassis import MASS, WHEEL_MASS, WHEEL_PLACE, check_wheels
from triform.simulators.mujoco.shapes import UNTOUCHED, RobotParts, chassis, inertia
from triform.simulators.mujoco.wheeled import ARMATURE, WheeledBase

#: Rollers of a wheel, their largest radius [m] and their share of its mass.
_ROLLERS = 12
_ROLLER_RADIUS = 0.014
_ROLLER_SHARE = 0.4
#: Friction in a roller's bearings [N m s].
_ROLLER_DAMPING = 1e-5
#: Wheels: place in front of and beside the centre, in units of ``WHEEL_PLACE``.
_WHEELS = {"front_left": (1, 1), "front_right": (1, -1), "rear_left": (-1, 1), "rear_right": (-1, -1)}
#: Rates of the wheels that make a body twist, shape (4, 3) [rad/m, rad/m, 1].
_RATES = np.array([[1, -forward * left, -2 * WHEEL_PLACE * left] for forward, left in _WHEELS.values()]) / WHEEL_RADIUS


class MecanumBase(WheeledBase):
    """The bases of B worlds of N robots on mecanum wheels."""

    def __init__(self, batch: Batch, robots: int, profile: Profile) -> None:
        """Take the simulations, and what the bases can do."""
        super().__init__(batch, robots, profile.drive, _RATES, 1 + _ROLLERS)

    @staticmethod
    def write_robot(index: int, profile: Profile) -> RobotParts:
        """Return a robot, and the rollers that touch the ground.

        Raises:
            ConfigurationError: The wheels do not fit under the footprint.
        """
        check_wheels(profile.footprint)
        wheels = "".join(
            _write_wheel(f"{name}{index}", forward * WHEEL_PLACE, left * WHEEL_PLACE, forward * left)
            for name, (forward, left) in _WHEELS.items()
        )
        pairs = "".join(
            f'<pair geom1="ground" geom2="{name}{index}_{roller}"/>' for name in _WHEELS for roller in range(_ROLLERS)
        )
        body = chassis(index, profile.footprint, MASS - len(_WHEELS) * WHEEL_MASS, WHEEL_RADIUS)
        return RobotParts(f'<body name="robot{index}"><freejoint/>{body}{wheels}</body>', pairs)


def _write_wheel(name: str, forward: float, left: float, hand: int) -> str:
    """Return a wheel whose rollers pull along (1, -``hand``) where they touch the ground.

    A roller that fills the rim exactly has the radius ``R - hypot(c, s / sqrt(2))`` at the distance ``s`` along its
    axis, which runs ``c`` from the axle. The ellipsoid here has the same curvature in its middle, and at the joint of
    two rollers it is 0.1 mm short of the rim.
    """
    mass = (1 - _ROLLER_SHARE) * WHEEL_MASS
    moment = 0.5 * mass * WHEEL_RADIUS**2
    rim = WHEEL_RADIUS - _ROLLER_RADIUS
    half_length = math.sqrt(2 * _ROLLER_RADIUS * rim)
    roller = _ROLLER_SHARE * WHEEL_MASS / _ROLLERS
    parts = []
    for number in range(_ROLLERS):
        angle = 2 * math.pi * number / _ROLLERS
        cos, sin = math.cos(angle), math.sin(angle)
        axis = f"{hand * cos} 1 {-hand * sin}"
        parts.append(f"""<body pos="{rim * sin} 0 {rim * cos}">
        <joint type="hinge" axis="{axis}" damping="{_ROLLER_DAMPING}"/>
        <geom name="{name}_{number}" type="ellipsoid" size="{_ROLLER_RADIUS} {_ROLLER_RADIUS} {half_length}"
          zaxis="{axis}" mass="{roller}" {UNTOUCHED} material="tyre"/>
      </body>""")
    return f"""<body pos="{forward} {left} {WHEEL_RADIUS}">
      <joint type="hinge" axis="0 1 0" armature="{ARMATURE}"/>{inertia(mass, 0.0, (moment, moment, moment))}
      {"".join(parts)}
    </body>"""
