"""A base on four mecanum wheels, each with rollers that turn by themselves."""

from __future__ import annotations

import math

import numpy as np
from mujoco.batch import Batch

from triform.simulation.kinematics import WHEEL_RADIUS, steer
from triform.simulation.profiles import Drive, Footprint
from triform.simulators.chassis import MASS, WHEEL_MASS, WHEEL_PLACE, check_wheels
from triform.simulators.mujoco.shapes import UNTOUCHED, RobotParts, chassis, inertia
from triform.types import FloatArray

#: Rollers of a wheel, their largest radius [m] and their share of its mass.
_ROLLERS = 12
_ROLLER_RADIUS = 0.014
_ROLLER_SHARE = 0.4
#: Friction in a roller's bearings [N m s].
_ROLLER_DAMPING = 1e-5
#: Inertia that a motor adds to its wheel [kg m^2]: enough that the ground does not change the speed that it is set to.
_ARMATURE = 1.0
#: Wheels: place in front of and beside the centre, in units of ``WHEEL_PLACE``.
_WHEELS = {"front_left": (1, 1), "front_right": (1, -1), "rear_left": (-1, 1), "rear_right": (-1, -1)}
#: Rates of the wheels that make a body twist, shape (4, 3) [rad/m, rad/m, 1], and the twist that rates make, (3, 4).
_RATES = np.array([[1, -forward * left, -2 * WHEEL_PLACE * left] for forward, left in _WHEELS.values()]) / WHEEL_RADIUS
_TWIST = np.linalg.pinv(_RATES)
#: Joints of a wheel, its own first, and of all wheels.
_WHEEL_JOINTS = 1 + _ROLLERS
_JOINTS = len(_WHEELS) * _WHEEL_JOINTS


class MecanumBase:
    """The bases of B worlds of N robots on mecanum wheels, whose motors keep the speeds that a body twist asks for."""

    #: Step of the physics [s].
    time_step = 0.002

    def __init__(self, batch: Batch, robots: int, drive: Drive, footprint: Footprint) -> None:
        """Take the simulations, and what the bases can do.

        Raises:
            ConfigurationError: The wheels do not fit under the footprint.
        """
        check_wheels(footprint)
        self._places: FloatArray = batch.qpos.reshape(batch.nsim, robots, 7 + _JOINTS)
        self._rates = batch.qvel.reshape(batch.nsim, robots, 6 + _JOINTS)
        self._wheels = self._rates[..., 6::_WHEEL_JOINTS]
        self._drive = drive

    @staticmethod
    def write_robot(index: int, footprint: Footprint) -> RobotParts:
        """Return a robot, and the rollers that touch the ground."""
        wheels = "".join(
            _write_wheel(f"{name}{index}", forward * WHEEL_PLACE, left * WHEEL_PLACE, forward * left)
            for name, (forward, left) in _WHEELS.items()
        )
        pairs = "".join(
            f'<pair geom1="ground" geom2="{name}{index}_{roller}"/>' for name in _WHEELS for roller in range(_ROLLERS)
        )
        body = chassis(index, footprint, MASS - len(_WHEELS) * WHEEL_MASS, WHEEL_RADIUS)
        return RobotParts(f'<body name="robot{index}"><freejoint/>{body}{wheels}</body>', pairs)

    @property
    def poses(self) -> FloatArray:
        """Poses in the world frame, shape (B, N, 3) [m, m, rad]."""
        return np.concatenate([self._places[..., :2], self._headings[..., None]], axis=-1)

    @property
    def frames(self) -> FloatArray:
        """Positions and orientations as quaternions, shape (B, N, 7) [m, 1]."""
        return self._places[..., :7]

    @property
    def twists(self) -> FloatArray:
        """Body twists, shape (B, N, 3) [m/s, m/s, rad/s]."""
        cos, sin = np.cos(self._headings), np.sin(self._headings)
        x, y, turn = self._rates[..., 0], self._rates[..., 1], self._rates[..., 5]
        return np.stack([cos * x + sin * y, cos * y - sin * x, turn], axis=-1)

    def place(self, world: int, robot: int, pose: FloatArray) -> None:
        """Put a robot down at ``pose``, shape (3,), at rest."""
        x, y, heading = pose
        self._places[world, robot] = 0.0
        self._places[world, robot, :7] = [x, y, 0.0, math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)]
        self._rates[world, robot] = 0.0

    def drive(self, targets: FloatArray) -> None:
        """Turn the wheels for one step of the physics, so that limited body twists, shape (B, N, 3), are approached."""
        _, wanted = steer(self.poses, self._wheels @ _TWIST.T, targets, self._drive, self.time_step)
        self._wheels[:] = wanted @ _RATES.T

    @property
    def _headings(self) -> FloatArray:
        """Headings, shape (B, N) [rad]."""
        w, x, y, z = np.moveaxis(self._places[..., 3:7], -1, 0)
        headings: FloatArray = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return headings


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
          zaxis="{axis}" mass="{roller}" {UNTOUCHED} material="roller"/>
      </body>""")
    return f"""<body pos="{forward} {left} {WHEEL_RADIUS}">
      <joint type="hinge" axis="0 1 0" armature="{_ARMATURE}"/>{inertia(mass, 0.0, (moment, moment, moment))}
      {"".join(parts)}
    </body>"""
