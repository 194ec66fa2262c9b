"""ROS messages to and from the arrays of triform. All else about them is in ``triform.robots``."""

from __future__ import annotations

import array
import math

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Twist, TwistStamped, Vector3
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import LaserScan as LaserScanMessage

from triform.robots.laser_scan import LaserScan
from triform.simulation import Mounting
from triform.types import FloatArray, MapArray, MapConfig, RangeArray, ScanConfig


def laser_scan(message: LaserScanMessage) -> LaserScan:
    """Return what a scan's message says.

    Raises:
        ConfigurationError: It contradicts itself.
    """
    return LaserScan(
        np.array(message.ranges, dtype=np.float32),
        message.angle_min,
        message.angle_max,
        message.angle_increment,
        message.range_min,
        message.range_max,
        np.array(message.intensities, dtype=np.float32),
    )


def scan_message(
    ranges: RangeArray,
    intensities: RangeArray | None,
    config: ScanConfig,
    mounting: Mounting,
    scan_time: float,
    rolling: bool,
) -> LaserScanMessage:
    """Return the message of a full turn as a LiDAR's driver sends it, in the LiDAR's frame; stamp and frame are empty.

    Args:
        ranges: Ranges from the LiDAR, shape (R,) [m].
        intensities: How bright the returns are, shape (R,); ``None`` if the LiDAR does not say.
        config: The directions of its rays in the base's frame, and limits of range.
        mounting: How the LiDAR is mounted.
        scan_time: Time of the turn [s].
        rolling: Whether rays are measured one after another, and not at once.
    """
    first, last = (mounting.direction * (angle - mounting.yaw) for angle in (config.angle_min, config.angles[-1]))
    return LaserScanMessage(
        angle_min=float(first),
        angle_max=float(last),
        angle_increment=mounting.direction * config.angle_increment,
        time_increment=scan_time / config.rays if rolling else 0.0,
        scan_time=scan_time,
        range_min=config.range_min,
        range_max=config.range_max,
        ranges=_floats(ranges),
        intensities=_floats([] if intensities is None else intensities),
    )


def numbers_of(transform: Transform) -> tuple[list[float], list[float]]:
    """Return translation [m] and quaternion (x, y, z, w) of a transform."""
    place, turn = transform.translation, transform.rotation
    return [place.x, place.y, place.z], [turn.x, turn.y, turn.z, turn.w]


def mounting_transform(mounting: Mounting, base: str, lidar: str) -> TransformStamped:
    """Return the transform of a mounted LiDAR's frame; its stamp is left empty."""
    cos, sin = math.cos(mounting.yaw / 2), math.sin(mounting.yaw / 2)
    # Upside down is half a turn about the axis that the LiDAR's zero has.
    turn = Quaternion(z=sin, w=cos) if mounting.upright else Quaternion(x=cos, y=sin, w=0.0)
    message = TransformStamped(child_frame_id=lidar)
    message.header.frame_id = base
    message.transform = Transform(translation=Vector3(x=mounting.x, y=mounting.y), rotation=turn)
    return message


def twist_of(message: Twist | TwistStamped) -> FloatArray:
    """Return the body twist of a command, shape (3,) [m/s, m/s, rad/s]."""
    twist = message.twist if isinstance(message, TwistStamped) else message
    return np.array([twist.linear.x, twist.linear.y, twist.angular.z])


def fill_twist(twist: Twist, command: FloatArray) -> None:
    """Write a body twist, shape (3,), into a message."""
    twist.linear.x, twist.linear.y, twist.angular.z = (float(value) for value in command)


def pose_of(message: Odometry) -> FloatArray:
    """Return the pose of an odometry message, shape (3,) [m, m, rad]."""
    position, turn = message.pose.pose.position, message.pose.pose.orientation
    heading = math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))
    return np.array([position.x, position.y, heading])


def fill_odometry(message: Odometry, pose: FloatArray, command: FloatArray) -> None:
    """Write a pose and a body twist, shapes (3,), into a message."""
    message.pose.pose.position.x, message.pose.pose.position.y = float(pose[0]), float(pose[1])
    message.pose.pose.orientation = Quaternion(z=math.sin(pose[2] / 2), w=math.cos(pose[2] / 2))
    fill_twist(message.twist.twist, command)


def map_message(occupied: MapArray, config: MapConfig) -> OccupancyGrid:
    """Return the message of an occupancy map, shape (H, W); stamp and frame are left empty.

    A message counts its cells along x first, and rows of a map grow with x: so it holds the map transposed.
    """
    message = OccupancyGrid()
    message.info.resolution = config.cell
    message.info.width = message.info.height = config.size
    message.info.origin.position.x = message.info.origin.position.y = -config.half_extent
    message.data = array.array("b", (100 * occupied.T).astype(np.int8).tobytes())
    return message


def _floats(values: RangeArray | list[float]) -> array.array[float]:
    """Return values as a message takes them."""
    return array.array("f", np.asarray(values, dtype=np.float32).tobytes())


def seconds(stamp: Time) -> float:
    """Return a stamp in seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)
