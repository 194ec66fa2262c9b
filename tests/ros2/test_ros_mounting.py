"""Where a controller has the LiDAR's mounting from: /tf_static, or its parameters."""

from __future__ import annotations

import math
import signal
from typing import Any

import numpy as np

from tests.ros2.conftest import Ros
from tests.ros2.test_ros_controller import GRID, Robot, expected, scan_message, scene, twist


def transform(parent: str, child: str, x: float = 0.0, roll: float = 0.0, yaw: float = 0.0) -> Any:
    """A transform by x, then yaw, then roll; one of both must be none or the other half a turn."""
    from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3

    half_yaw, half_roll = yaw / 2, roll / 2
    turn = Quaternion(
        x=math.cos(half_yaw) * math.sin(half_roll), y=math.sin(half_yaw) * math.sin(half_roll),
        z=math.sin(half_yaw) * math.cos(half_roll), w=math.cos(half_yaw) * math.cos(half_roll),
    )  # fmt: skip
    message = TransformStamped(child_frame_id=child, transform=Transform(translation=Vector3(x=x), rotation=turn))
    message.header.frame_id = parent
    return message


def publish(ros: Ros, *transforms: Any) -> None:
    """Publish latched transforms, as a robot_state_publisher does."""
    from tf2_msgs.msg import TFMessage

    from triform_ros.static_frames import LATCHED

    message = TFMessage()
    message.transforms = list(transforms)
    ros.node.create_publisher(TFMessage, "/tf_static", LATCHED).publish(message)


def hanging(ranges: np.ndarray, yaw_rays: int) -> np.ndarray:
    """What a LiDAR shows that hangs upside down, turned by so many rays, in the order of its own angles."""
    return np.roll(ranges, -yaw_rays)[-np.arange(GRID.rays) % GRID.rays]


def test_static_transforms_tell_how_the_lidar_hangs_unless_parameters_do(ros: Ros) -> None:
    from geometry_msgs.msg import TwistStamped

    ros.add_transforms()
    yaw = 90
    # In two messages' worth of links, with a frame above the robot's.
    publish(
        ros,
        transform("plate", "laser", roll=math.pi),
        transform("footprint", "base", x=0.3),
        transform("base", "plate", yaw=yaw * GRID.angle_increment),
    )
    robot = Robot(ros, TwistStamped)
    common = {"controller": "scan-pipeline", "max_acceleration": 100.0, "base_frame": "base"}
    controller = ros.start("controller", **common)
    message = scan_message(hanging(scene(), yaw))
    message.header.frame_id = "laser"
    robot.send_until(message, moving=True)
    driven = [twist(each) for each in robot.send(message, 0.7) if any(twist(each))]
    np.testing.assert_allclose(driven, np.broadcast_to(expected(scene()), (len(driven), 3)), atol=1e-5)
    assert "turned by 72 degrees, upside down, by /tf_static" in controller.log
    assert controller.end(signal.SIGTERM) == 0

    told = ros.start("controller", **common, upside_down=True, mounting=yaw * GRID.angle_increment)
    robot.commands.clear()
    robot.send_until(message, moving=True)
    assert "turned by 72 degrees, upside down, from the parameters" in told.log
    assert told.end(signal.SIGTERM) == 0

    message.header.frame_id = "elsewhere"
    late = ros.start("controller", **common, tf_timeout=0.5)
    robot.commands.clear()
    robot.send_until(message, moving=True)
    assert "/tf_static has not said within 0.5 s where 'elsewhere' is in 'base'" in late.log
    assert late.end(signal.SIGTERM) == 0


def test_a_tilted_lidar_is_refused_and_the_last_command_is_zero(ros: Ros) -> None:
    from geometry_msgs.msg import TwistStamped

    ros.add_transforms()
    publish(ros, transform("base_link", "laser", roll=0.5))
    robot = Robot(ros, TwistStamped)
    controller = ros.start("controller", controller="scan-pipeline")
    message = scan_message(scene())
    message.header.frame_id = "laser"
    commands: list[Any] = []

    def ended() -> bool:
        commands.extend(robot.send(message, 0.1))
        return controller.process.poll() is not None

    ros.until(ended, "the refusal")
    assert controller.wait() == 1
    assert commands
    assert not np.any([twist(each) for each in commands])
    assert "the LiDAR is tilted by 29 degrees" in controller.log.splitlines()[-1]
