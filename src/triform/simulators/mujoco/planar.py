"""A base that a force and a torque move over a ground without friction."""

from __future__ import annotations

import numpy as np
from mujoco.batch import Batch

from triform.simulation.kinematics import integrate, steer
from triform.simulation.profiles import Profile
from triform.simulators.chassis import MASS, moments_of_inertia
from triform.simulators.mujoco.shapes import RobotParts, chassis
from triform.types import FloatArray


class PlanarBase:
    """The bases of B worlds of N robots that slide along x and y and turn about z."""

    #: Step of the physics [s].
    time_step = 0.01

    def __init__(self, batch: Batch, robots: int, profile: Profile) -> None:
        """Take the simulations, and what the bases can do."""
        shape = (batch.nsim, robots, 3)
        self._places = batch.qpos.reshape(shape)
        self._rates = batch.qvel.reshape(shape)
        self._forces = batch.qfrc_applied.reshape(shape)
        self._inertia = np.array([MASS, MASS, moments_of_inertia(profile.footprint, MASS)[2]])
        self._drive = profile.drive

    @staticmethod
    def write_robot(index: int, profile: Profile) -> RobotParts:
        """Return a robot that nothing but forces moves."""
        return RobotParts(f"""<body name="robot{index}">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint type="hinge" axis="0 0 1"/>
      {chassis(index, profile.footprint, MASS, 0.0)}
    </body>""")

    @property
    def poses(self) -> FloatArray:
        """Poses in the world frame, shape (B, N, 3) [m, m, rad]."""
        return integrate(self._places, np.zeros_like(self._places), 0.0)

    @property
    def frames(self) -> FloatArray:
        """Positions and orientations as quaternions, shape (B, N, 7) [m, 1]."""
        x, y, heading = np.moveaxis(self._places, -1, 0)
        none = np.zeros_like(x)
        return np.stack([x, y, none, np.cos(heading / 2), none, none, np.sin(heading / 2)], axis=-1)

    @property
    def twists(self) -> FloatArray:
        """Body twists, shape (B, N, 3) [m/s, m/s, rad/s]."""
        # A velocity made the last step, so it belongs to the heading of half a step ago.
        heading = self._places[..., 2] - 0.5 * self.time_step * self._rates[..., 2]
        return _turned(self._rates, -heading)

    def place(self, world: int, robot: int, pose: FloatArray) -> None:
        """Put a robot down at ``pose``, shape (3,), at rest."""
        self._places[world, robot] = pose
        self._rates[world, robot] = 0.0

    def drive(self, targets: FloatArray) -> None:
        """Push for one step of the physics, so that limited body twists, shape (B, N, 3), are approached."""
        _, wanted = steer(self._places, self.twists, targets, self._drive, self.time_step)
        heading = self._places[..., 2] + 0.5 * self.time_step * wanted[..., 2]
        self._forces[:] = self._inertia * (_turned(wanted, heading) - self._rates) / self.time_step


def _turned(twists: FloatArray, angles: FloatArray) -> FloatArray:
    """Return twists, shape (..., 3), whose translation is turned by ``angles``, shape (...) [rad]."""
    cos, sin = np.cos(angles), np.sin(angles)
    x, y, turn = np.moveaxis(twists, -1, 0)
    return np.stack([cos * x - sin * y, sin * x + cos * y, turn], axis=-1)
