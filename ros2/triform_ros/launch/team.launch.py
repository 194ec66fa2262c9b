"""A simulated team with one controller per robot: ``ros2 launch triform_ros team.launch.py simulator:=world``."""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription


def _team(context: LaunchContext) -> list[Node]:
    given = {name: LaunchConfiguration(name).perform(context) for name in ("simulator", "robots", "seed", "profile")}
    robots, seed = int(given["robots"]), int(given["seed"])
    profile = {"profile": given["profile"]}
    bridge = {"simulator": given["simulator"], "robots": robots, "seed": seed, **profile}
    controllers = [
        Node(
            package="triform_ros",
            executable="controller",
            namespace=f"robot{k}",
            parameters=[{"base_frame": f"robot{k}/base_link", **profile}],
            output="screen",
        )
        for k in range(robots)
    ]
    return [
        Node(package="triform_ros", executable="gazebo_bridge", parameters=[bridge], output="screen"),
        *controllers,
    ]


def generate_launch_description() -> LaunchDescription:
    """Return the bridge and the controllers of all its robots."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("simulator", default_value="gazebo", description="gazebo or world"),
            DeclareLaunchArgument("robots", default_value="5", description="Number of robots"),
            DeclareLaunchArgument("seed", default_value="7", description="Seed of the start"),
            DeclareLaunchArgument(
                "profile", default_value="", description="Profile of all robots; empty for ideal ones"
            ),
            OpaqueFunction(function=_team),
        ]
    )
