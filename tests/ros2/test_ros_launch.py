"""What the launch files start. There are no wheels of ``launch``, so that stand-ins take its place."""

from __future__ import annotations

import runpy
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree as ET

import pytest
import yaml

from tests.ros2.conftest import PACKAGE

STAND_INS: dict[str, dict[str, Any]] = {
    "launch": {"LaunchDescription": list, "LaunchContext": dict},
    "launch.actions": {
        "DeclareLaunchArgument": lambda name, default_value, description: (name, default_value),
        "OpaqueFunction": lambda function: function,
        "IncludeLaunchDescription": lambda source, launch_arguments: SimpleNamespace(
            source=source, arguments=dict(launch_arguments)
        ),
        "LogInfo": lambda msg: msg,
    },
    "launch.conditions": {"IfCondition": lambda wanted: wanted},
    "launch.launch_description_sources": {"PythonLaunchDescriptionSource": Path},
    "launch.substitutions": {"LaunchConfiguration": lambda name: SimpleNamespace(name=name, perform=lambda c: c[name])},
    "launch_ros": {},
    "launch_ros.actions": {"Node": lambda **options: SimpleNamespace(**options)},
    "ament_index_python": {},
    "ament_index_python.packages": {"get_package_share_directory": lambda name: PACKAGE.parent / name},
}


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run a launch file; return its arguments with their defaults, and its other actions."""
    for name, content in STAND_INS.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)

    def run(name: str) -> tuple[dict[str, str], list[Any]]:
        actions = runpy.run_path(str(PACKAGE / "launch" / name))["generate_launch_description"]()
        arguments = dict(each for each in actions if isinstance(each, tuple))
        return arguments, [each for each in actions if not isinstance(each, tuple)]

    return run


def test_one_controller_has_its_namespace_and_a_file_of_parameters_that_exist(
    launched: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments, (node, rviz) = launched("controller.launch.py")
    assert (node.package, node.executable, node.namespace.name) == ("triform_ros", "controller", "namespace")
    assert [each.name for each in node.parameters] == ["parameters"]
    assert [(topic, to.name) for topic, to in node.remappings] == [("/tf_static", "tf_static")]
    assert arguments["tf_static"] == "/tf_static"
    assert (rviz.package, rviz.condition.name, arguments["rviz"]) == ("rviz2", "rviz", "false")
    if find_spec("rclpy") is None:
        pytest.skip("rclpy is missing; the extra ros has it")
    monkeypatch.syspath_prepend(str(PACKAGE))
    from triform_ros.settings import Settings, parameters

    files = sorted((PACKAGE / "config").glob("*.yaml"))
    assert Path(arguments["parameters"]) in files
    for file in files:
        given = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]
        defaults = {each.name: each.default for each in parameters(given["profile"])}
        assert {name: type(value) for name, value in given.items()} == {name: type(defaults[name]) for name in given}
        settings = Settings({**defaults, **given})
        settings.make_controller()
        assert settings.robot.name == given["profile"]


def test_rviz_shows_topics_and_namespaces_that_the_controller_has(launched: Any) -> None:
    _, (_, rviz) = launched("controller.launch.py")
    shown = yaml.safe_load(Path(rviz.arguments[1]).read_text())["Visualization Manager"]
    topics = {each["Topic"]["Value"]: each for each in shown["Displays"] if "Topic" in each}
    assert set(topics) == {"/scan", "/markers", "/map"} == {name for name, _ in rviz.remappings} - {"/tf_static"}
    assert set(topics["/markers"]["Namespaces"]) == {"neighbours", "intended", "command", "allowed"}


def test_a_team_is_a_bridge_and_a_controller_for_each_of_its_robots(launched: Any) -> None:
    arguments, (team,) = launched("team.launch.py")
    bridge, *controllers = team(arguments | {"robots": "3", "profile": "turtlebot4"})
    assert (bridge.package, bridge.executable) == ("triform_ros", "gazebo_bridge")
    assert bridge.parameters == [{"simulator": "gazebo", "robots": 3, "seed": 7, "profile": "turtlebot4"}]
    assert [each.parameters for each in controllers] == [
        [{"base_frame": f"robot{k}/base_link", "profile": "turtlebot4"}] for k in range(3)
    ]
    assert [each.namespace for each in controllers] == ["robot0", "robot1", "robot2"]
    assert {(each.package, each.executable) for each in controllers} == {("triform_ros", "controller")}


@pytest.mark.parametrize(("profile", "gui"), [("turtlebot4", "false"), ("ideal", "true")])
def test_a_team_in_modern_gazebo_is_a_world_a_bridge_and_controllers(
    launched: Any, profile: str, gui: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    arguments, (team,) = launched("gz_team.launch.py")
    note, gazebo, bridge, *controllers = team(arguments | {"robots": "3", "profile": profile, "gui": gui})
    (folder,) = tmp_path.iterdir()
    assert note.endswith(str(folder))
    assert gazebo.source.parts[-3:] == ("ros_gz_sim", "launch", "gz_sim.launch.py")
    *options, world = gazebo.arguments["gz_args"].split()
    assert options == (["-r"] if gui == "true" else ["-r", "-s", "--headless-rendering"])
    models = [each.get("name") for each in ET.parse(world).iter("model")]
    assert models == ["ground", "robot0", "robot1", "robot2"]
    assert (bridge.package, bridge.executable) == ("ros_gz_bridge", "parameter_bridge")
    topics = [each["ros_topic_name"] for each in yaml.safe_load(Path(bridge.parameters[0]["config_file"]).read_text())]
    assert [each.namespace for each in controllers] == ["robot0", "robot1", "robot2"]
    assert topics == ["/clock"] + [f"/robot{k}/{name}" for k in range(3) for name in ("scan", "odom", "cmd_vel")]
    (settings,) = controllers[0].parameters
    assert settings["profile"] == profile
    # The bridge's commands are stamped, and its stamps are of simulated time.
    assert settings["stamped"]
    assert settings["use_sim_time"]
    assert settings["lidar_position"] == ([-0.04, 0.0] if profile == "turtlebot4" else [0.0, 0.0])
