"""One robot: ``ros2 launch triform_ros controller.launch.py namespace:=robot0``."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Return the controller of one robot, with a file of parameters, and RViz if wanted."""
    config = Path(get_package_share_directory("triform_ros")) / "config"
    frames = ("/tf_static", LaunchConfiguration("tf_static"))
    shown = [(f"/{topic}", topic) for topic in ("scan", "markers", "map")]
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the robot's topics"),
            DeclareLaunchArgument(
                "parameters", default_value=str(config / "controller.yaml"), description="File of parameters"
            ),
            DeclareLaunchArgument(
                "tf_static", default_value="/tf_static", description="Topic of static transforms; tf_static for its own"
            ),
            DeclareLaunchArgument("rviz", default_value="false", description="Whether to start RViz beside it"),
            Node(
                package="triform_ros",
                executable="controller",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("parameters")],
                remappings=[frames],
                output="screen",
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                namespace=LaunchConfiguration("namespace"),
                arguments=["-d", str(config / "triform.rviz")],
                remappings=[frames, *shown],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
