"""MuJoCo: the model that it simulates, how bases move in it, what LiDARs see, and the team of it all."""

from __future__ import annotations

from triform.simulators.mujoco.lidar import RayCaster
from triform.simulators.mujoco.model import write_model
from triform.simulators.mujoco.team import MujocoError, MujocoTeam

__all__ = ["MujocoError", "MujocoTeam", "RayCaster", "write_model"]
