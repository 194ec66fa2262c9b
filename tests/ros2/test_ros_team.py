"""Five simulated robots on ROS topics, each with a controller of its own, form up and form up again."""

from __future__ import annotations

import os
import re
import signal
from functools import partial
from typing import Any

import numpy as np
import pytest

from tests.ros2.conftest import Ros
from triform.evaluation.metrics import TOLERANCE, WINDOW
from triform.geometry import edge_error
from triform.simulators.gazebo import find_gazebo

ROBOTS = 5
RATE = 10.0
NAMES = [f"robot{k}" for k in range(ROBOTS)]


def note(track: list[list[float]], message: Any) -> None:
    """Append a pose (x, y, heading)."""
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    track.append([place.x, place.y, 2 * np.arctan2(turn.z, turn.w)])


class Observer:
    """Notes where all robots are."""

    def __init__(self, ros: Ros) -> None:
        from nav_msgs.msg import Odometry

        self._ros = ros
        self.tracks: list[list[list[float]]] = [[] for _ in NAMES]
        for name, track in zip(NAMES, self.tracks, strict=True):
            ros.node.create_subscription(Odometry, f"{name}/odom", partial(note, track), 50)

    def error(self) -> float:
        """Mean relative edge error of the last 5 s."""
        span = int(WINDOW * RATE)
        if min(map(len, self.tracks)) < span:
            return np.inf
        positions = np.array([track[-span:] for track in self.tracks])[..., :2].swapaxes(0, 1)[None]
        return float(edge_error(positions, 1.0, np.inf, np.ones((1, span, ROBOTS), dtype=bool)).mean())

    def wait_for_formation(self, what: str) -> float:
        for track in self.tracks:
            track.clear()
        self._ros.until(lambda: self.error() < TOLERANCE, what, patience=90.0)
        return self.error()


@pytest.mark.slow
def test_a_team_forms_up_and_forms_up_again_around_a_robot_whose_controller_died(ros: Ros) -> None:
    """In Gazebo, or in the built-in world where there is none."""
    from geometry_msgs.msg import Twist

    simulator = "gazebo" if find_gazebo() or "TRIFORM_REQUIRE_GAZEBO" in os.environ else "world"
    observer = Observer(ros)
    bridge = ros.start("gazebo_bridge", simulator=simulator, robots=ROBOTS, rate=RATE, seed=3)
    controllers = [ros.start("controller", namespace=name) for name in NAMES]
    observer.wait_for_formation("forming up")

    controllers[0].end(signal.SIGKILL)
    ros.listen(1.5)
    # Somebody carries the robot off, and leaves it there.
    carry = ros.node.create_publisher(Twist, f"{NAMES[0]}/cmd_vel", 1)
    ros.until(lambda: carry.get_subscription_count() > 0, "the topic of the robot")
    before = np.array(observer.tracks[0][-1])
    centre = np.mean([track[-1][:2] for track in observer.tracks], axis=0)
    out = complex(*(before[:2] - centre)) * np.exp(-1j * before[2])
    out *= 0.5 / abs(out)
    command = Twist()
    command.linear.x, command.linear.y = out.real, out.imag

    def carried() -> bool:
        carry.publish(command)
        ros.listen(0.1)
        return bool(np.linalg.norm(observer.tracks[0][-1][:2] - before[:2]) > 0.8)

    ros.until(carried, "the way of the robot")
    ros.listen(1.5)
    rests = np.array(observer.tracks[0][-1])
    observer.wait_for_formation("forming up again")
    np.testing.assert_allclose(observer.tracks[0][-1], rests, atol=1e-6)

    # Nobody publishes any more when the controllers say what they have received.
    assert bridge.end(signal.SIGINT) == 0
    ros.listen(0.5)
    published = re.search(r"published (\d+) scans", bridge.log)
    assert published is not None
    for each in controllers[1:]:
        assert each.end(signal.SIGINT) == 0
        assert f"received {published[1]} scans, refused 0, lost 0" in each.log
