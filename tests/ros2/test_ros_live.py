"""What a controller shows of itself, and what may change while it runs."""

from __future__ import annotations

import signal
from typing import Any

import numpy as np
import pytest

from tests.ros2.conftest import Ros
from tests.ros2.test_ros_controller import GRID, ORDER, Robot, expected, scan_message, scene, twist


def set_parameter(ros: Ros, name: str, value: Any) -> Any:
    """Set a parameter of the controller as ``ros2 param set`` does; return the result."""
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    return ros.call(SetParameters, "/controller/set_parameters", request).results[0]


class Reports:
    """The controller's diagnostics."""

    def __init__(self, ros: Ros) -> None:
        from diagnostic_msgs.msg import DiagnosticArray

        self._ros, self.got = ros, []
        ros.node.create_subscription(DiagnosticArray, "/diagnostics", lambda each: self.got.extend(each.status), 10)

    def wait_for(self, state: str, robot: Robot, scan: Any) -> Any:
        """Send scans until a report has this state; return it."""
        self.got.clear()

        def reported() -> bool:
            robot.send(scan, 0.1)
            return bool(self.got) and self.values(self.got[-1])["state"] == state

        self._ros.until(reported, f"the report {state}")
        return self.got[-1]

    @staticmethod
    def values(status: Any) -> dict[str, str]:
        return {each.key: each.value for each in status.values}


def test_a_disabled_robot_stands_until_enabled_and_reports_what_it_does(ros: Ros) -> None:
    from diagnostic_msgs.msg import DiagnosticStatus
    from geometry_msgs.msg import TwistStamped
    from std_srvs.srv import SetBool

    robot, reports = Robot(ros, TwistStamped), Reports(ros)
    controller = ros.start("controller", controller="scan-pipeline", max_acceleration=100.0, enabled=False)
    good = scan_message(scene())
    status = reports.wait_for("disabled", robot, good)
    assert (status.level, status.name) == (DiagnosticStatus.OK, "controller: control")
    robot.send(good, 0.5)
    assert not np.any([twist(each) for each in robot.send(good, 0.5)])

    answer = ros.call(SetBool, "/controller/enable", SetBool.Request(data=True))
    assert (answer.success, answer.message) == (True, "enabled: True")
    robot.send_until(good, moving=True)
    status = reports.wait_for("driving", robot, good)
    assert (status.level, status.message) == (DiagnosticStatus.OK, "driving")
    values = reports.values(status)
    assert int(values["scans received"]) > 10
    assert (values["scans refused"], values["takers of commands"]) == ("0", "1")
    assert 0.0 <= float(values["age of the scan [s]"]) < 0.5

    bad = scan_message(scene(), range_max=1.0)
    status = reports.wait_for("standing", robot, bad)
    assert status.level == DiagnosticStatus.WARN
    assert "no scan that can be used" in status.message
    assert int(reports.values(status)["scans refused"]) > 0
    robot.send_until(good, moving=True)

    assert ros.call(SetBool, "/controller/enable", SetBool.Request(data=False)).success
    robot.send_until(good, moving=False)
    assert not np.any([twist(each) for each in robot.send(good, 0.5)])
    assert controller.end(signal.SIGTERM) == 0


def test_parameters_change_while_the_robot_drives_or_are_refused_in_a_sentence(ros: Ros) -> None:
    from geometry_msgs.msg import TwistStamped

    robot = Robot(ros, TwistStamped)
    controller = ros.start("controller", controller="scan-pipeline", max_acceleration=100.0)
    good = scan_message(scene())
    robot.send_until(good, moving=True)

    def speed() -> float:
        robot.send(good, 0.3)
        return float(np.hypot(*twist(robot.send(good, 0.3)[-1])[:2]))

    assert speed() == pytest.approx(np.hypot(*expected(scene())[:2]), abs=1e-6)
    assert set_parameter(ros, "max_speed", 0.05).successful
    assert speed() == pytest.approx(0.05, abs=1e-6)
    assert set_parameter(ros, "min_gap", 1.5).successful
    assert speed() < 0.05
    assert set_parameter(ros, "min_gap", 0.05).successful
    assert speed() == pytest.approx(0.05, abs=1e-6)
    # At a distance of 0.7 m, the robot beside is no longer too near but right.
    before = np.array(twist(robot.send(good, 0.3)[-1]))
    assert set_parameter(ros, "distance", 0.75).successful
    robot.send(good, 0.3)
    assert not np.allclose(twist(robot.send(good, 0.3)[-1]), before, atol=1e-3)

    for name, value, told in (
        ("max_speed", 99.0, "max_speed"),
        ("max_speed", "fast", "type"),
        ("rays", 200, "read-only"),
        ("drive", "differential", "read-only"),
    ):
        result = set_parameter(ros, name, value)
        assert not result.successful
        assert told in result.reason
        assert "\n" not in result.reason
    # The LiDAR reaches 12 m; 2 d* may not be more, and then scans are refused, not the parameter.
    assert set_parameter(ros, "distance", 4.0).successful
    robot.send(good, 0.3)
    assert set_parameter(ros, "distance", 1.0).successful
    robot.send_until(good, moving=True)
    assert controller.end(signal.SIGTERM) == 0


def test_markers_show_neighbours_intention_command_and_what_the_filter_allows(ros: Ros) -> None:
    from geometry_msgs.msg import TwistStamped
    from nav_msgs.msg import OccupancyGrid
    from visualization_msgs.msg import MarkerArray

    shown: list[Any] = []
    maps: list[Any] = []
    robot = Robot(ros, TwistStamped)
    ros.node.create_subscription(MarkerArray, "markers", shown.append, 10)
    ros.node.create_subscription(OccupancyGrid, "map", maps.append, 10)
    controller = ros.start("controller", controller="scan-pipeline", max_acceleration=100.0, base_frame="robot/base")
    good = scan_message(scene())
    robot.send_until(good, moving=True)
    robot.send(good, 0.5)
    assert maps == []
    markers = {each.ns: each for each in shown[-1].markers}
    assert set(markers) == {"neighbours", "intended", "command", "allowed"}
    assert {each.header.frame_id for each in markers.values()} == {"robot/base"}
    points = {name: np.array([[each.x, each.y] for each in marker.points]) for name, marker in markers.items()}
    centres = points["neighbours"][np.argsort(points["neighbours"][:, 0])]
    np.testing.assert_allclose(centres, [[0.0, 0.82], [1.52, 0.0]], atol=0.05)
    np.testing.assert_allclose(points["command"][-1], expected(scene())[:2], atol=1e-6)
    # The filter stops the robot from driving on at whoever is beside it, and holds it nowhere else.
    allowed = points["allowed"]
    assert allowed[:, 1].max() < 0.5
    assert allowed[:, 1].min() == pytest.approx(-0.5, abs=1e-3)
    assert np.hypot(*allowed.T).max() <= 0.5 + 1e-6

    assert set_parameter(ros, "publish_map", True).successful
    ros.until(lambda: bool(robot.send(good, 0.1)) and bool(maps), "the map")
    # The robot beside wears no tape: no neighbour, and as near to the filter as before.
    assert set_parameter(ros, "min_intensity", 100.0).successful
    robot.send_until(good, moving=False)
    assert "it says nothing about intensities" in controller.log
    ahead = np.abs(GRID.angles) < 0.5
    taped = scan_message(scene(), intensities=np.where(ahead, 200.0, 20.0)[ORDER].tolist())
    robot.send_until(taped, moving=True)
    shown.clear()
    robot.send(taped, 0.5)
    markers = {each.ns: each for each in shown[-1].markers}
    (neighbour,) = markers["neighbours"].points
    assert (neighbour.x, neighbour.y) == (pytest.approx(1.52, abs=0.05), pytest.approx(0.0, abs=0.05))
    still = np.array([[each.x, each.y] for each in markers["allowed"].points])
    np.testing.assert_allclose(still, allowed, atol=1e-6)
    assert set_parameter(ros, "min_intensity", 0.0).successful

    assert set_parameter(ros, "guard", False).successful
    robot.send(good, 0.3)
    assert {each.ns for each in shown[-1].markers} == {"neighbours", "intended", "command"}
    assert controller.end(signal.SIGTERM) == 0


def test_commands_that_nobody_takes_are_said_to_be_of_the_wrong_type_once(ros: Ros) -> None:
    from geometry_msgs.msg import Twist

    robot = Robot(ros, Twist)
    controller = ros.start("controller", controller="scan-pipeline")
    ros.until(lambda: "nobody takes the commands on /cmd_vel" in controller.log, "the warning")
    robot.send(scan_message(scene()), 2.5)
    assert robot.commands == []
    (line,) = [each for each in controller.log.splitlines() if "nobody takes the commands" in each]
    assert (
        "which are geometry_msgs/msg/TwistStamped; who listens takes geometry_msgs/msg/Twist: set stamped to false"
        in line
    )
    assert controller.end(signal.SIGTERM) == 0
