"""A team in modern Gazebo, one controller per robot: ``ros2 launch triform_ros gz_team.launch.py profile:=turtlebot4``.

It needs ``ros_gz_sim`` and ``ros_gz_bridge``. World and bridge are written into a temporary folder, which is named.
"""

import shlex
import tempfile
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, LogInfo, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription
from triform.simulation import get_arena, get_profile, sample_starts
from triform.simulators.gz_sim import write_bridge, write_gz_world

ARGUMENTS = {
    "robots": ("5", "Number of robots"),
    "profile": ("ideal", "Robot profile: a name or a TOML file"),
    "arena": ("open", "Walls and pillars: a name or a TOML file"),
    "seed": ("7", "Seed of the start"),
    "gui": ("true", "Whether Gazebo opens its window; without it, it needs no screen"),
}


def _team(context: LaunchContext) -> list[object]:
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    robots, profile = int(given["robots"]), get_profile(given["profile"])
    poses = sample_starts(robots, 1, int(given["seed"]))[0]
    folder = Path(tempfile.mkdtemp(prefix="triform-gz-"))
    world, bridge = folder / "world.sdf", folder / "bridge.yaml"
    world.write_text(write_gz_world(profile, get_arena(given["arena"]), poses), encoding="utf-8")
    bridge.write_text(write_bridge(robots), encoding="utf-8")
    options = "-r" if given["gui"] == "true" else "-r -s --headless-rendering"
    gazebo = Path(get_package_share_directory("ros_gz_sim")) / "launch" / "gz_sim.launch.py"
    mounting = profile.mounting
    settings = {
        "profile": given["profile"],
        "stamped": True,
        "use_sim_time": True,
        "lidar_position": [mounting.x, mounting.y],
        "mounting": mounting.yaw,
        "upside_down": not mounting.upright,
    }
    return [
        LogInfo(msg=f"world and bridge are in {folder}"),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(gazebo)),
            launch_arguments={
                "gz_args": f"{options} {shlex.quote(str(world))}",
                "on_exit_shutdown": "true",
            }.items(),
        ),
        Node(
            package="ros_gz_bridge",
            executable="parameter_bridge",
            parameters=[{"config_file": str(bridge)}],
            output="screen",
        ),
        *(
            Node(
                package="triform_ros",
                executable="controller",
                namespace=f"robot{k}",
                parameters=[settings],
                output="screen",
            )
            for k in range(robots)
        ),
    ]


def generate_launch_description() -> LaunchDescription:
    """Return Gazebo, the bridge to its topics and the controllers of all robots."""
    arguments = [
        DeclareLaunchArgument(name, default_value=value, description=text) for name, (value, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_team)])
