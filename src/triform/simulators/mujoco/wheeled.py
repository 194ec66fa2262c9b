"""Bases on wheels, as free bodies that stand on the ground, whose motors keep the speeds of the wheels."""

from __future__ import annotations

import math

import numpy as np
from mujoco.batch import Batch

from triform.simulation.kinematics import steer
from triform.simulation.profiles import Drive
from triform.types import FloatArray

#: Inertia that a motor adds to its wheel [kg m^2]: enough that the ground does not change the speed that it is set to.
ARMATURE = 1.0


class WheeledBase:
    """The bases of B worlds of N robots on wheels, whose motors keep the speeds that a body twist asks for."""

    #: Step of the physics [s].
    time_step = 0.002

    def __init__(self, batch: Batch, robots: int, drive: Drive, rates: FloatArray, joints: int) -> None:
        """Take the simulations, and what the bases can do.

        Args:
            batch: Simulations of models in which every robot has a free joint, then its wheels.
            robots: Number of robots in each.
            drive: Limits and lag.
            rates: Rates of W wheels that make a body twist, shape (W, 3) [rad/m, rad/m, 1].
            joints: Joints of each wheel, its own first.
        """
        self._places: FloatArray = batch.qpos.reshape(batch.nsim, robots, 7 + len(rates) * joints)
        self._rates = batch.qvel.reshape(batch.nsim, robots, 6 + len(rates) * joints)
        self._wheels = self._rates[..., 6::joints]
        self._wheel_rates, self._twist = rates, np.linalg.pinv(rates)
        self._drive = drive

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
        _, wanted = steer(self.poses, self._wheels @ self._twist.T, targets, self._drive, self.time_step)
        self._wheels[:] = wanted @ self._wheel_rates.T

    @property
    def _headings(self) -> FloatArray:
        """Headings, shape (B, N) [rad]."""
        w, x, y, z = np.moveaxis(self._places[..., 3:7], -1, 0)
        headings: FloatArray = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return headings
