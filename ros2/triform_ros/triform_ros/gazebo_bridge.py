"""The executable ``gazebo_bridge``: simulated robots on topics, in real time.

Robot ``k`` lives in the namespace ``robot<k>``: it publishes ``scan`` and ``odom`` and obeys ``cmd_vel``. Its odometry
is its true pose in the frame ``world``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

from triform.simulation import sample_starts
from triform.types import FloatArray, ScanConfig, TriformError
from triform_ros.conversions import fill_odometry, scan_message, twist_of
from triform_ros.executable import run_executable
from triform_ros.parameters import Parameter, declare
from triform_ros.simulators import Moment, bridge_profile, open_simulator

PARAMETERS = (
    Parameter("simulator", "gazebo", "Where the robots are: gazebo or world, the built-in one"),
    Parameter("robots", 5, "Number of robots", 1, 100),
    Parameter("seed", 7, "Of the start", 0, 2**31 - 1),
    Parameter("rate", 10.0, "Scans and commands per second [Hz]", 1.0, 50.0),
    Parameter("distance", 1.0, "Prescribed neighbour distance d*, with which the start grows [m]", 0.05, 4.0),
    Parameter("arena", "open", "Walls and pillars: open, room-6 or pillars"),
    Parameter("stamped", False, "Whether commands are TwistStamped and not Twist"),
    Parameter("command_timeout", 0.5, "A robot that has not been commanded for so long stands [s]", 0.05, 5.0),
    Parameter("wait", True, "Whether time begins only when every robot has a controller"),
)

#: Controllers that have just appeared get so long to hear the first scan [s].
_GREETING = 1.0


class RobotTopics:
    """The topics of one robot."""

    def __init__(self, node: Node, name: str, stamped: bool) -> None:
        """Advertise and subscribe in the namespace ``name``."""
        self.name = name
        self.commanded = -np.inf
        self._command: FloatArray = np.zeros(3)
        self._scan = node.create_publisher(LaserScan, f"{name}/scan", qos_profile_sensor_data)
        self._odom = node.create_publisher(Odometry, f"{name}/odom", 10)
        node.create_subscription(TwistStamped if stamped else Twist, f"{name}/cmd_vel", self._take, 1)

    @property
    def is_controlled(self) -> bool:
        """Whether somebody listens to the scans and has sent a command."""
        return self.commanded > 0 and self._scan.get_subscription_count() > 0

    def command(self, timeout: float) -> FloatArray:
        """Return the newest command, shape (3,), or zero if it is older than ``timeout`` [s]."""
        return self._command if time.monotonic() - self.commanded <= timeout else np.zeros(3)

    def publish(self, moment: Moment, robot: int, scan: ScanConfig, period: float, stamp: Time) -> None:
        """Publish scan and odometry of robot number ``robot``."""
        message = scan_message(moment.ranges[robot], scan, period, rolling=False)
        message.header.stamp, message.header.frame_id = stamp, f"{self.name}/base_link"
        odometry = Odometry(child_frame_id=f"{self.name}/base_link")
        odometry.header.stamp, odometry.header.frame_id = stamp, "world"
        fill_odometry(odometry, moment.poses[robot], moment.twists[robot])
        self._odom.publish(odometry)
        self._scan.publish(message)

    def _take(self, message: Twist | TwistStamped) -> None:
        command = twist_of(message)
        if np.isfinite(command).all():
            self._command, self.commanded = command, time.monotonic()


class Bridge:
    """Simulated robots with their topics."""

    def __init__(self, node: Node) -> None:
        """Start the simulator and connect everything.

        Raises:
            TriformError: A parameter cannot be used, or the simulator cannot be started.
        """
        self.node = node
        given = declare(node, PARAMETERS)
        profile = bridge_profile(given["rate"], given["distance"])
        self._period, self._scan = profile.control_period, profile.lidar.scan
        self._timeout, self._wait = given["command_timeout"], given["wait"]
        self._robots = [RobotTopics(node, f"robot{k}", given["stamped"]) for k in range(given["robots"])]
        poses = sample_starts(given["robots"], 1, given["seed"], distance=given["distance"])[0]
        self._simulator = open_simulator(given["simulator"], poses, profile, given["arena"])
        self._published = 0
        self._began = time.monotonic()

    def run(self, check: Callable[[], None]) -> None:
        """Publish, wait for the rest of the control period and simulate one, over and over.

        Raises:
            TriformError: ROS has been shut down, or the simulator is lost.
        """
        self._check = check
        if self._wait:
            self._wait_for_controllers()
        self._began = due = time.monotonic()
        moment = self._simulator.step(np.zeros((len(self._robots), 3)))
        while True:
            stamp = self.node.get_clock().now().to_msg()
            for k, robot in enumerate(self._robots):
                robot.publish(moment, k, self._scan, self._period, stamp)
            self._published += 1
            due = max(due + self._period, time.monotonic())
            self._sleep(due - time.monotonic())
            moment = self._simulator.step(np.stack([robot.command(self._timeout) for robot in self._robots]))

    def stop(self) -> None:
        """End the simulator and say how it went."""
        self._simulator.close()
        factor = max(self._published - 1, 0) * self._period / max(time.monotonic() - self._began, self._period)
        self.node.get_logger().info(
            f"published {self._published} scans of each of {len(self._robots)} robots, real-time factor {factor:.3f}"
        )

    def _wait_for_controllers(self) -> None:
        while missing := [robot.name for robot in self._robots if not robot.is_controlled]:
            self.node.get_logger().info(f"waiting for controllers of {', '.join(missing)}", throttle_duration_sec=5.0)
            self._sleep(0.1)
        self._sleep(_GREETING)

    def _sleep(self, duration: float) -> None:
        """Wait [s], as long as there is ROS."""
        self._check()
        if not self.node.context.ok():
            raise TriformError("ROS has been shut down; nothing can be published")
        time.sleep(max(0.0, duration))


def main(args: list[str] | None = None) -> int:
    """Simulate robots in real time. Returns the exit status."""
    return run_executable("gazebo_bridge", Bridge, args)


if __name__ == "__main__":
    sys.exit(main())
