"""The LiDAR's mounting from the topic ``/tf_static``.

There are no wheels of ``tf2``, and none of it is needed: frames that do not move are a chain of constant transforms.
"""

from __future__ import annotations

from importlib.util import find_spec

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from triform.robots.frames import FrameTree, mounting_of
from triform.simulation import Mounting
from triform.types import ConfigurationError
from triform_ros.conversions import numbers_of

#: Static transforms are latched: who comes later gets them too.
LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def has_transforms() -> bool:
    """Tell whether this installation of ROS knows messages of transforms."""
    return find_spec("tf2_msgs") is not None


class StaticFrames:
    """Frames that do not move."""

    def __init__(self, node: Node) -> None:
        """Subscribe."""
        from tf2_msgs.msg import TFMessage

        self._node, self._tree = node, FrameTree()
        self._subscription = node.create_subscription(TFMessage, "/tf_static", self._take, LATCHED)

    def close(self) -> None:
        """Listen no more."""
        self._node.destroy_subscription(self._subscription)

    def mounting(self, base: str, lidar: str, blind_sectors: tuple[tuple[float, float], ...]) -> Mounting | None:
        """Return how a LiDAR is mounted; ``None`` if no chain of transforms tells.

        Args:
            base: Frame of the robot.
            lidar: Frame of its scans.
            blind_sectors: See ``Mounting``.

        Raises:
            ConfigurationError: The LiDAR is tilted.
        """
        pose = self._tree.pose(lidar.lstrip("/"), base.lstrip("/"))
        return None if pose is None else mounting_of(pose, blind_sectors)

    def _take(self, message: object) -> None:
        for each in message.transforms:  # type: ignore[attr-defined]
            parent, child = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
            try:
                self._tree.add(parent, child, *numbers_of(each.transform))
            except ConfigurationError as error:
                self._node.get_logger().warning(f"a transform on /tf_static cannot be used: {error}")
