"""The executable ``gazebo_bridge``: simulated robots on topics, in real time.

Robot ``k`` lives in the namespace ``robot<k>``: it publishes ``scan`` and ``odom`` and obeys ``cmd_vel``. Its scans are
those of its LiDAR, from where that is mounted, which ``/tf_static`` tells; its odometry is its true pose in the frame
``world``.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

from triform.simulation import Profile, sample_starts
from triform.types import FloatArray, TriformError
from triform_ros.conversions import fill_odometry, mounting_transform, scan_message, twist_of
from triform_ros.executable import run_executable
from triform_ros.parameters import Parameter, declare
from triform_ros.settings import wants_stamped
from triform_ros.simulators import Moment, bridge_profile, open_simulator
from triform_ros.static_frames import LATCHED, has_transforms

PARAMETERS = (
    Parameter("simulator", "gazebo", "Where the robots are: gazebo or world, the built-in one"),
    Parameter("profile", "", "Profile of the robots: a name or a TOML file; empty for ideal ones"),
    Parameter("robots", 5, "Number of robots", 1, 100),
    Parameter("seed", 7, "Of the start and of the robots' errors", 0, 2**31 - 1),
    Parameter("rate", 10.0, "Commands per second, and scans of ideal robots [Hz]", 1.0, 50.0),
    Parameter("distance", 1.0, "Prescribed neighbour distance d*, with which the start grows [m]", 0.05, 4.0),
    Parameter("arena", "open", "Walls and pillars: open, room-6 or pillars"),
    Parameter(
        "stamped", wants_stamped(os.environ.get("ROS_DISTRO")), "Whether commands are TwistStamped and not Twist"
    ),
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

    def publish_odometry(self, moment: Moment, robot: int, stamp: Time) -> None:
        """Publish the odometry of robot number ``robot``."""
        message = Odometry(child_frame_id=f"{self.name}/base_link")
        message.header.stamp, message.header.frame_id = stamp, "world"
        fill_odometry(message, moment.poses[robot], moment.twists[robot])
        self._odom.publish(message)

    def publish_scan(self, moment: Moment, robot: int, profile: Profile, stamp: Time) -> None:
        """Publish the newest scan of robot number ``robot``, whose first ray was measured at ``stamp``."""
        lidar = profile.lidar
        bright = None if moment.intensities is None else moment.intensities[robot]
        form = (profile.from_lidar, profile.mounting, lidar.period, lidar.rolling)
        message = scan_message(moment.ranges[robot], bright, *form)
        message.header.stamp, message.header.frame_id = stamp, f"{self.name}/laser"
        self._scan.publish(message)

    def transform(self, profile: Profile) -> TransformStamped:
        """Return where its LiDAR is."""
        return mounting_transform(profile.mounting, f"{self.name}/base_link", f"{self.name}/laser")

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
        self._profile = profile = bridge_profile(given["profile"], given["rate"], given["distance"])
        self._timeout, self._wait = given["command_timeout"], given["wait"]
        self._robots = [RobotTopics(node, f"robot{k}", given["stamped"]) for k in range(given["robots"])]
        poses = sample_starts(given["robots"], 1, given["seed"], distance=given["distance"])[0]
        self._simulator = open_simulator(given["simulator"], poses, profile, given["arena"], given["seed"])
        if has_transforms():
            self._publish_transforms()
        self._periods = self._published = 0
        self._collided = False
        self._began = time.monotonic()

    def run(self, check: Callable[[], None]) -> None:
        """Publish, wait for the rest of the control period and simulate one, over and over.

        Raises:
            TriformError: ROS has been shut down, or the simulator is lost.
        """
        self._check = check
        if self._wait:
            self._wait_for_controllers()
        period, newest = self._profile.control_period, -np.inf
        self._began = due = time.monotonic()
        moment = self._simulator.step(np.zeros((len(self._robots), 3)))
        while True:
            self._collided |= moment.collided
            now = self.node.get_clock().now()
            is_new = moment.began > newest and moment.began >= 0
            first_ray = (now - Duration(nanoseconds=round(1e9 * (moment.time - moment.began)))).to_msg()
            for k, robot in enumerate(self._robots):
                robot.publish_odometry(moment, k, now.to_msg())
                if is_new:
                    robot.publish_scan(moment, k, self._profile, first_ray)
            newest = max(newest, moment.began)
            self._periods, self._published = self._periods + 1, self._published + is_new
            due = max(due + period, time.monotonic())
            self._sleep(due - time.monotonic())
            moment = self._simulator.step(np.stack([robot.command(self._timeout) for robot in self._robots]))

    def stop(self) -> None:
        """End the simulator and say how it went."""
        self._simulator.close()
        period = self._profile.control_period
        factor = max(self._periods - 1, 0) * period / max(time.monotonic() - self._began, period)
        self.node.get_logger().info(
            f"published {self._published} scans of each of {len(self._robots)} robots, real-time factor {factor:.3f}, "
            f"{'some' if self._collided else 'no'} robots overlapped"
        )

    def _publish_transforms(self) -> None:
        """Say where the LiDARs are, to all who ask from now on."""
        from tf2_msgs.msg import TFMessage

        message, stamp = TFMessage(), self.node.get_clock().now().to_msg()
        transforms = [robot.transform(self._profile) for robot in self._robots]
        for each in transforms:
            each.header.stamp = stamp
        message.transforms = transforms
        self._transforms = self.node.create_publisher(TFMessage, "/tf_static", LATCHED)
        self._transforms.publish(message)

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
