"""IR-SIM: one world of rectangles with LiDARs at a time, from a YAML file."""

from __future__ import annotations

import contextlib
import io
import json
import math
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from triform.simulation import Footprint
from triform.types import FloatArray, ScanConfig

# It prints which windows it cannot open.
with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    import irsim


def same_angles(scan: ScanConfig) -> ScanConfig:
    """The scan with the angles that IR-SIM can have: the same spacing, symmetric around the robot's front."""
    return replace(scan, angle_min=-math.pi * (1 - 1 / scan.rays))


class IrsimWorld:
    """One world of robots standing at given poses."""

    def __init__(self, poses: FloatArray, footprint: Footprint, scan: ScanConfig, step_time: float) -> None:
        """Place robots at poses (N, 3) [m, m, rad]; ``step_time`` [s] is the length of a step."""
        lidar = {
            "type": "lidar2d",
            "range_min": 0,
            "range_max": scan.range_max,
            "angle_range": 2 * math.pi * (1 - 1 / scan.rays),
            "number": scan.rays,
        }
        shape = {"name": "rectangle", "length": footprint.length, "width": footprint.width}
        robots = [
            {"kinematics": {"name": "omni_angular"}, "shape": shape, "state": pose.tolist(), "sensors": [lidar]}
            for pose in poses
        ]
        side = 2 * float(np.abs(poses[:, :2]).max()) + 2
        world = {"width": side, "height": side, "offset": [-side / 2, -side / 2], "step_time": step_time}
        world["collision_mode"] = "unobstructed"
        with TemporaryDirectory() as folder:
            path = Path(folder) / "world.yaml"
            # JSON is YAML.
            path.write_text(json.dumps({"world": world, "robot": robots}))
            self._env = irsim.make(str(path), headless=True, log_level="ERROR")
        self.step()

    def sense(self) -> None:
        """Measure with every robot's LiDAR; nobody moves."""
        for robot in self._env.robot_list:
            robot.sensor_step()

    def step(self) -> None:
        """Advance the world by one step, LiDARs included; the robots have no commands and stand still."""
        self._env.step()

    def ranges(self) -> FloatArray:
        """Newest ranges, shape (N, R) [m]; a ray without return has the limit."""
        return np.array([robot.get_lidar_scan()["ranges"] for robot in self._env.robot_list])
