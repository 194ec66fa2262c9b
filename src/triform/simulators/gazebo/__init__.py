"""Gazebo 11 in lock-step: its build, the world it simulates, and the process that runs it."""

from __future__ import annotations

from triform.simulators.gazebo.installation import Installation, find_gazebo
from triform.simulators.gazebo.sdf import write_world
from triform.simulators.gazebo.server import GazeboError, GazeboServer, State
from triform.simulators.gazebo.team import GazeboTeam

__all__ = [
    "GazeboError",
    "GazeboServer",
    "GazeboTeam",
    "Installation",
    "State",
    "find_gazebo",
    "write_world",
]
