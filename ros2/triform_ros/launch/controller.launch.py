"""One robot: ``ros2 launch triform_ros controller.launch.py namespace:=robot0``."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Return the controller of one robot, with a file of parameters."""
    settings = Path(get_package_share_directory("triform_ros")) / "config" / "controller.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the robot's topics"),
            DeclareLaunchArgument("parameters", default_value=str(settings), description="File of parameters"),
            Node(
                package="triform_ros",
                executable="controller",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("parameters")],
                output="screen",
            ),
        ]
    )
