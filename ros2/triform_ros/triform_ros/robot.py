"""A robot whose LiDAR and wheels are topics: the ``Lidar`` and the ``Base`` of ``triform.robots.real.RealRobot``."""

from __future__ import annotations

import math
import time

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.duration import Duration
from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan as LaserScanMessage

from triform.perception import MapRules, map_workspace, occupied_into
from triform.robots.laser_scan import Turn
from triform.robots.limits import limit_acceleration
from triform.robots.odometry import Track
from triform.simulation import Drive, Mounting, Profile
from triform.types import FloatArray, MapArray, MapConfig, ScanConfig, TriformError, View
from triform_ros.conversions import fill_twist, laser_scan, map_message, pose_of, seconds

#: A repeated message is shown this often at most [s].
_THROTTLE = 5.0
#: Subscribers of commands are counted once in this time [s], and this many times before the robot warns of having none.
_LISTENERS_PERIOD, _PATIENT_CHECKS = 1.0, 10
#: How long the last command may take to be acknowledged [s].
_LAST_COMMAND = 1.0


def host_time(node: Node, stamp: Time) -> float:
    """Return a stamp by the host's monotonic clock [s].

    A stamp that was left zero, or lies in the future of the node's clock, counts as now: no scan may stay fresh for
    longer because the clock of another computer is ahead.
    """
    age = 1e-9 * node.get_clock().now().nanoseconds - seconds(stamp)
    return time.monotonic() - (max(age, 0.0) if stamp.sec or stamp.nanosec else 0.0)


class ScanTopic:
    """The LiDAR behind the topic ``scan``.

    A scan that cannot be used takes the place of the one before: the robot then has none, and stands. So it does until
    it is known how the LiDAR is mounted.

    Attributes:
        seen_frame: Frame of the newest scan; ``None`` before the first one.
        received: Scans that came.
        refused: Those of them that could not be used.
        lost: Scans that were sent and did not come, as far as ROS knows.
    """

    def __init__(self, node: Node, frame: str) -> None:
        """Subscribe.

        Args:
            node: Where the topic is.
            frame: Frame that scans must be in; any if empty.
        """
        self._node, self._frame = node, frame
        self._scan, self._mounting = ScanConfig(), Mounting()
        self._placed = self._needs_intensities = False
        self.seen_frame: str | None = None
        self._turn: Turn | None = None
        self._told_coverage = False
        self.received = self.refused = self.lost = 0
        node.create_subscription(
            LaserScanMessage,
            "scan",
            self._take,
            qos_profile_sensor_data,
            event_callbacks=SubscriptionEventCallbacks(message_lost=self._count_lost),
        )

    @property
    def scan(self) -> ScanConfig:
        """Shape of its turns."""
        return self._scan

    def place(self, robot: Profile) -> None:
        """Say how the LiDAR is mounted, and how far and fine its scans are to be."""
        self._scan, self._mounting, self._placed = robot.from_lidar, robot.mounting, True
        self._needs_intensities = robot.lidar.min_intensity is not None

    def latest(self) -> Turn | None:
        """Return the newest scan; ``None`` before the first one, and if it cannot be used."""
        turn = self._turn
        # One from before min_intensity was set may have none.
        is_dark = turn is not None and turn.intensities is None
        return None if is_dark and self._needs_intensities else turn

    def _take(self, message: LaserScanMessage) -> None:
        self.received += 1
        self.seen_frame = message.header.frame_id
        if not self._placed:
            return
        try:
            self._turn = self._read(message)
        except TriformError as error:
            self._turn = None
            self.refused += 1
            self._node.get_logger().warning(
                f"a scan cannot be used, the robot stands still: {error}", throttle_duration_sec=_THROTTLE
            )

    def _read(self, message: LaserScanMessage) -> Turn:
        frame = message.header.frame_id
        if self._frame and frame != self._frame:
            raise TriformError(f"it is in the frame {frame!r}, not in {self._frame!r}")
        scan = laser_scan(message).mounted(self._mounting)
        turn = message.time_increment * (len(message.ranges) - 1)
        if not (math.isfinite(turn) and turn >= 0):
            raise TriformError(f"time_increment is {message.time_increment} s; it must be finite and not negative")
        ranges, intensities = scan.on_grid(self._scan), scan.intensities_on_grid(self._scan)
        if self._needs_intensities and intensities is None:
            raise TriformError("it says nothing about intensities, which min_intensity needs")
        if scan.coverage < 0.99 and not self._told_coverage:
            self._told_coverage = True
            self._node.get_logger().info(f"scans cover {360 * scan.coverage:.0f} of 360 degrees; the rest is not seen")
        started = host_time(self._node, message.header.stamp)
        return Turn(ranges, started, min(started + turn, time.monotonic()), intensities)

    def _count_lost(self, lost: QoSMessageLostInfo) -> None:
        self.lost += lost.total_count_change


class TwistTopic:
    """The wheels behind the topic ``cmd_vel``, and their odometry on the topic ``odom``.

    Attributes:
        enabled: Whether commands are sent as they are; they are zero otherwise.
        listeners: Subscriptions to ``cmd_vel`` that take its type.
    """

    def __init__(self, node: Node, frame: str, stamped: bool, odometry: bool, limits: Drive, period: float) -> None:
        """Advertise, and subscribe if odometry is wanted.

        Args:
            node: Where the topics are.
            frame: The robot's frame, for stamped commands.
            stamped: Whether commands are ``TwistStamped`` and not ``Twist``.
            odometry: Whether to listen to ``odom``.
            limits: Commands change no faster than these accelerations allow.
            period: Time between two commands [s].
        """
        self._node, self._frame, self._stamped = node, frame, stamped
        self._period = period
        self._command: FloatArray = np.zeros(3)
        self.enabled = True
        self.listeners = self._checks = 0
        self._fastest: list[float] = []
        self.limit(limits)
        self._publisher = node.create_publisher(TwistStamped if stamped else Twist, "cmd_vel", 1)
        node.create_timer(_LISTENERS_PERIOD, self._count_listeners)
        if odometry:
            node.create_subscription(Odometry, "odom", self._note, qos_profile_sensor_data)

    def limit(self, limits: Drive) -> None:
        """Say what the base can do from now on, and how fast commands may change."""
        speed = min(limits.max_speed, math.sqrt(2) * limits.max_axis_speed)
        fastest = [speed, speed, limits.max_turn_rate]
        if fastest != self._fastest:
            self._fastest, self._history = fastest, Track(fastest, angle=True)
        self._limits = limits

    def drive(self, command: FloatArray) -> None:
        """Publish a body twist, shape (3,), as far as the accelerations allow; zero unless the robot is enabled.

        Raises:
            TriformError: ROS has been shut down.
        """
        if not self._node.context.ok():
            raise TriformError("ROS has been shut down; no command can be sent")
        wanted = command if self.enabled else np.zeros(3)
        self._command = limit_acceleration(wanted, self._command, self._limits, self._period)
        self._publish()

    def stop(self) -> None:
        """Publish zero, and wait until those who listen have it."""
        if self._node.context.ok():
            self._command = np.zeros(3)
            self._publish()
            self._publisher.wait_for_all_acked(Duration(seconds=_LAST_COMMAND))

    def odometry(self, at: float) -> FloatArray | None:
        """Return the pose at a moment of the host's monotonic clock [s], shape (3,); ``None`` if it is not known."""
        return self._history.at(at)

    def _publish(self) -> None:
        if self._stamped:
            message = TwistStamped()
            message.header.stamp = self._node.get_clock().now().to_msg()
            message.header.frame_id = self._frame
            fill_twist(message.twist, self._command)
        else:
            message = Twist()
            fill_twist(message, self._command)
        self._publisher.publish(message)

    def _count_listeners(self) -> None:
        """Count the subscribers of the commands, and warn once if there is none."""
        topic, own = self._publisher.topic_name, f"geometry_msgs/msg/{self._publisher.msg_type.__name__}"
        types = [each.topic_type for each in self._node.get_subscriptions_info_by_topic(topic)]
        self.listeners = types.count(own)
        if self.listeners or self._checks > _PATIENT_CHECKS:
            return
        self._checks += 1
        others = sorted(set(types))
        if others or self._checks > _PATIENT_CHECKS:
            self._checks = _PATIENT_CHECKS + 1
            whom = f"who listens takes {', '.join(others)}: set stamped to {str(not self._stamped).lower()}"
            self._node.get_logger().warning(
                f"nobody takes the commands on {topic}, which are {own}; "
                + (whom if others else "nobody listens there: see that the robot's driver is in this namespace")
            )

    def _note(self, message: Odometry) -> None:
        self._history.add(host_time(self._node, message.header.stamp), pose_of(message))


class MapTopic:
    """The occupancy map that the policy sees, on the topic ``map``, in the robot's frame."""

    def __init__(self, node: Node, frame: str) -> None:
        """Prepare for maps in a frame, the robot's."""
        self._node, self._frame = node, frame
        self._publisher: Publisher | None = None

    def show(self, reach: float, config: MapConfig) -> None:
        """Advertise, and say what the maps are.

        Args:
            reach: Farther returns are not drawn [m].
            config: The map.
        """
        self._reach, self._config = reach, config
        self._workspace = map_workspace(config.size)
        self._publisher = self._publisher or self._node.create_publisher(OccupancyGrid, "map", 1)

    def publish(self, view: View) -> None:
        """Publish the map of what the policy sees, if anybody listens."""
        if self._publisher is None or self._publisher.get_subscription_count() == 0:
            return
        message = map_message(self._occupied(view), self._config)
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = self._frame
        self._publisher.publish(message)

    def _occupied(self, view: View) -> MapArray:
        config, angles = self._config, view.scans.config.angles
        odometry = np.zeros(3) if view.odometry is None else view.odometry[0, 0]
        rules = MapRules(self._reach, config.cell, config.min_cells, config.max_cells)
        rays = (view.scans.ranges[0, 0], odometry, np.cos(angles), np.sin(angles))
        count = occupied_into(*rays, rules, self._workspace)
        occupied = np.zeros(config.size**2, dtype=np.uint8)
        occupied[self._workspace.cells[:count]] = 1
        return occupied.reshape(config.size, config.size)
