"""Three simulated TurtleBot 4 on ROS topics, as their users have them, form a triangle."""

from __future__ import annotations

import signal

import numpy as np
import pytest

from tests.ros2.conftest import Ros
from tests.ros2.observer import Observer
from triform.evaluation.metrics import TOLERANCE

ROBOTS = 3
NAMES = [f"robot{k}" for k in range(ROBOTS)]


@pytest.mark.slow
def test_rolling_robots_with_a_lidar_off_the_centre_form_a_triangle(ros: Ros) -> None:
    """Commands are stamped, the LiDAR is turned by 90 degrees and 4 cm behind the axle, and /tf_static says so."""
    ros.add_transforms()
    observer = Observer(ros, NAMES, rate=10.0)
    bridge = ros.start("gazebo_bridge", simulator="world", profile="turtlebot4", robots=ROBOTS, seed=3)
    controllers = [
        ros.start("controller", namespace=name, profile="turtlebot4", base_frame=f"{name}/base_link") for name in NAMES
    ]
    observer.wait_for_formation("forming up")
    # Three in a row are a formation too, but no triangle.
    ros.until(observer.is_triangulation, "the triangle", patience=90.0)
    ros.listen(5.0)
    assert observer.error() < TOLERANCE
    assert observer.is_triangulation()
    for track in observer.tracks:
        poses = np.array(track)
        step, heading = np.diff(poses[:, :2], axis=0), poses[:-1, 2] + np.diff(np.unwrap(poses[:, 2])) / 2
        aside = step[:, 1] * np.cos(heading) - step[:, 0] * np.sin(heading)
        assert np.abs(aside).max() < 1e-3
    assert bridge.end(signal.SIGINT) == 0
    assert "no robots overlapped" in bridge.log
    for each in controllers:
        assert each.end(signal.SIGINT) == 0
        assert "the LiDAR is -0.040 m ahead and 0.000 m left of the robot's centre, turned by 90 degrees" in each.log
        assert "upright, by /tf_static" in each.log
        assert "driving a differential base as in the profile 'turtlebot4'" in each.log
