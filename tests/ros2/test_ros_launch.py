"""What the launch files start. There are no wheels of ``launch``, so that stand-ins take its place."""

from __future__ import annotations

import runpy
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import yaml

from tests.ros2.conftest import PACKAGE

STAND_INS: dict[str, dict[str, Any]] = {
    "launch": {"LaunchDescription": list, "LaunchContext": dict},
    "launch.actions": {
        "DeclareLaunchArgument": lambda name, default_value, description: (name, default_value),
        "OpaqueFunction": lambda function: function,
    },
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
    arguments, (node,) = launched("controller.launch.py")
    assert (node.package, node.executable, node.namespace.name) == ("triform_ros", "controller", "namespace")
    assert [each.name for each in node.parameters] == ["parameters"]
    given = yaml.safe_load(Path(arguments["parameters"]).read_text())["/**"]["ros__parameters"]
    if find_spec("rclpy") is None:
        pytest.skip("rclpy is missing; the extra ros has it")
    monkeypatch.syspath_prepend(str(PACKAGE))
    from triform_ros.controller import PARAMETERS

    defaults = {each.name: each.default for each in PARAMETERS}
    assert {name: type(value) for name, value in given.items()} == {name: type(defaults[name]) for name in given}


def test_a_team_is_a_bridge_and_a_controller_for_each_of_its_robots(launched: Any) -> None:
    arguments, (team,) = launched("team.launch.py")
    bridge, *controllers = team(arguments | {"robots": "3"})
    assert (bridge.package, bridge.executable) == ("triform_ros", "gazebo_bridge")
    assert bridge.parameters == [{"simulator": "gazebo", "robots": 3, "seed": 7}]
    assert [each.namespace for each in controllers] == ["robot0", "robot1", "robot2"]
    assert {(each.package, each.executable) for each in controllers} == {("triform_ros", "controller")}
