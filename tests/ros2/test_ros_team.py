"""Five simulated robots on ROS topics, each with a controller of its own, form up and form up again."""

from __future__ import annotations

import os
import re
import signal

import numpy as np
import pytest

from tests.ros2.conftest import Ros
from tests.ros2.observer import Observer
from triform.simulators.gazebo import find_gazebo

ROBOTS = 5
RATE = 10.0
NAMES = [f"robot{k}" for k in range(ROBOTS)]


@pytest.mark.slow
def test_a_team_forms_up_and_forms_up_again_around_a_robot_whose_controller_died(ros: Ros) -> None:
    """In Gazebo, or in the built-in world where there is none."""
    from geometry_msgs.msg import TwistStamped

    simulator = "gazebo" if find_gazebo() or "TRIFORM_REQUIRE_GAZEBO" in os.environ else "world"
    observer = Observer(ros, NAMES, RATE)
    bridge = ros.start("gazebo_bridge", simulator=simulator, robots=ROBOTS, rate=RATE, seed=3)
    controllers = [ros.start("controller", namespace=name) for name in NAMES]
    observer.wait_for_formation("forming up")

    controllers[0].end(signal.SIGKILL)
    ros.listen(1.5)
    # Somebody carries the robot off, and leaves it there.
    carry = ros.node.create_publisher(TwistStamped, f"{NAMES[0]}/cmd_vel", 1)
    ros.until(lambda: carry.get_subscription_count() > 0, "the topic of the robot")
    before = np.array(observer.tracks[0][-1])
    centre = np.mean([track[-1][:2] for track in observer.tracks], axis=0)
    out = complex(*(before[:2] - centre)) * np.exp(-1j * before[2])
    out *= 0.5 / abs(out)
    command = TwistStamped()
    command.twist.linear.x, command.twist.linear.y = out.real, out.imag

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
