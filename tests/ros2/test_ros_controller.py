"""The executable ``controller`` from outside: messages in, messages out."""

from __future__ import annotations

import math
import signal
import time
from typing import Any

import numpy as np
import pytest

from tests.ros2.conftest import Executable, Ros
from triform.control import SafetyFilter, SafetySettings, make_controller
from triform.perception import occupancy_maps
from triform.types import MapConfig, Scan, ScanConfig, View

GRID = ScanConfig()
#: Rays clockwise from the front on, as some LiDARs have them.
ORDER = (GRID.rays // 2 - np.arange(GRID.rays)) % GRID.rays


def scene(ahead: float = 1.4, beside: float = 0.7) -> np.ndarray:
    """Ranges of a robot ahead and one to the left, each 0.24 m wide, counter-clockwise from behind."""
    ranges = np.full(GRID.rays, np.inf, np.float32)
    ranges[np.abs(GRID.angles) < 0.12 / ahead] = ahead
    ranges[np.abs(GRID.angles - np.pi / 2) < 0.12 / beside] = beside
    return ranges


def scan_message(ranges: np.ndarray, **changed: Any) -> Any:
    """A scan clockwise from the front on, as some LiDARs have it."""
    from sensor_msgs.msg import LaserScan

    told = {
        "angle_min": 0.0,
        "angle_max": -(GRID.rays - 1) * GRID.angle_increment,
        "angle_increment": -GRID.angle_increment,
        "range_min": 0.02,
        "range_max": 12.0,
    }
    return LaserScan(ranges=ranges[ORDER].tolist(), **(told | changed))


class Robot:
    """The other end of a controller's topics."""

    def __init__(self, ros: Ros, command: Any) -> None:
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import LaserScan

        self._ros = ros
        self.commands: list[Any] = []
        ros.node.create_subscription(command, "cmd_vel", self.commands.append, 10)
        self._scans = ros.node.create_publisher(LaserScan, "scan", qos_profile_sensor_data)

    def send(self, message: Any, seconds: float) -> list[Any]:
        """Send a scan ten times a second; return the commands that came meanwhile."""
        self.commands.clear()
        for _ in range(round(10 * seconds)):
            message.header.stamp = self._ros.node.get_clock().now().to_msg()
            self._scans.publish(message)
            self._ros.listen(0.1)
        return list(self.commands)

    def send_until(self, message: Any, moving: bool) -> None:
        """Send a scan until the controller drives, or until it stands."""
        deadline = time.monotonic() + 60
        while not (self.commands and np.any(twist(self.commands[-1])) == moving):
            assert time.monotonic() < deadline, f"the robot does not {'move' if moving else 'stand'}"
            self.send(message, 0.2)


def twist(message: Any) -> list[float]:
    """Body twist of a command, stamped or not."""
    inner = getattr(message, "twist", message)
    return [inner.linear.x, inner.linear.y, inner.angular.z]


def expected(ranges: np.ndarray) -> np.ndarray:
    """What the guarded controller answers to a scan, later in a run, cut to 0.5 m/s."""
    controller = SafetyFilter(make_controller("scan-pipeline"), SafetySettings(max_speed=0.5))
    view = View(Scan(ranges[None, None], GRID), np.ones((1, 1), dtype=bool), 10.0)
    command = controller.command(view)[0, 0]
    return command * min(1.0, 0.5 / np.hypot(*command[:2]))


def test_scans_become_commands_and_bad_or_old_ones_and_sigterm_stop_the_robot(ros: Ros) -> None:
    from geometry_msgs.msg import TwistStamped

    robot = Robot(ros, TwistStamped)
    controller = ros.start("controller", controller="scan-pipeline", max_acceleration=100.0)
    good = scan_message(scene())
    moves = expected(scene())
    assert np.hypot(*moves[:2]) > 0.1
    robot.send_until(good, moving=True)
    # On a loaded machine scans may be late, and the robot then stands for a moment.
    driven = [twist(each) for each in robot.send(good, 1.0) if any(twist(each))]
    np.testing.assert_allclose(driven, np.broadcast_to(moves, (len(driven), 3)), atol=1e-6)

    bad = [
        {"angle_increment": 0.0},
        {"angle_min": math.nan},
        {"angle_max": 1.0},
        {"range_max": 1.0},
        {"time_increment": -1.0},
    ]
    for changed in bad:
        robot.send_until(scan_message(scene(), **changed), moving=False)
        assert not np.any([twist(each) for each in robot.send(scan_message(scene(), **changed), 0.4)])
        robot.send_until(good, moving=True)
    assert 1 <= controller.log.count("a scan cannot be used") <= 1 + len(bad)

    robot.commands.clear()
    ros.until(lambda: bool(robot.commands) and not any(twist(robot.commands[-1])), "the stop without scans")
    assert "no new scan for 0.5 s" in controller.log

    robot.send_until(good, moving=True)
    controller.process.send_signal(signal.SIGTERM)
    ros.until(lambda: not any(twist(robot.commands[-1])), "the last command")
    assert controller.wait() == 0
    assert "received" in controller.log


def test_a_mounted_lidar_shows_the_same_robots_and_one_that_measures_nothing_stops_the_robot(ros: Ros) -> None:
    """It hangs upside down, sees an arm of the robot itself, and goes blind in two ways."""
    from geometry_msgs.msg import Twist

    robot = Robot(ros, Twist)
    controller = ros.start(
        "controller", controller="scan-pipeline", max_acceleration=100.0, upside_down=True, blind_sectors="-95:-85",
        stamped=False,
    )  # fmt: skip
    surroundings = scene()
    surroundings[np.abs(GRID.angles + np.pi / 2) < 0.08] = 0.4  # In the blind sector.
    surroundings[np.abs(GRID.angles + 2.0) < 0.1] = 0.1  # Within the outline.
    hanging = surroundings[-np.arange(GRID.rays) % GRID.rays]
    robot.send_until(scan_message(hanging), moving=True)
    driven = [twist(each) for each in robot.send(scan_message(hanging), 1.0) if any(twist(each))]
    np.testing.assert_allclose(driven, np.broadcast_to(expected(scene()), (len(driven), 3)), atol=1e-6)
    assert controller.log.count("within the robot's own outline") == 1

    for nothing in (np.inf, 0.0):
        blind = scan_message(np.full(GRID.rays, nothing, np.float32))
        robot.send_until(blind, moving=False)
        assert not np.any([twist(each) for each in robot.send(blind, 0.5)])
        robot.send_until(scan_message(hanging), moving=True)
    assert controller.log.count("stands still until it sees again") == 2
    assert controller.end(signal.SIGTERM) == 0


def test_commands_are_stamped_gentle_and_end_with_zero_on_sigint(ros: Ros) -> None:
    from geometry_msgs.msg import TwistStamped

    robot = Robot(ros, TwistStamped)
    controller = ros.start(
        "controller", controller="scan-pipeline", max_acceleration=0.4, max_speed=0.3,
        base_frame="robot/base", control_rate=20.0,
    )  # fmt: skip
    good = scan_message(scene(2.0, 1.9))
    robot.send_until(good, moving=True)
    robot.commands.clear()
    ros.until(lambda: bool(robot.commands) and not any(twist(robot.commands[-1])), "the stop without scans")
    commands = robot.send(good, 3.0)
    assert {each.header.frame_id for each in commands} == {"robot/base"}
    stamps = [each.header.stamp.sec + 1e-9 * each.header.stamp.nanosec for each in commands]
    assert (np.diff(stamps) > 0).all()
    moves = np.array([twist(each) for each in commands])
    speeds = np.hypot(moves[:, 0], moves[:, 1])
    assert 0.1 < speeds.max() <= 0.3 + 1e-6
    assert np.diff(speeds).max() <= 0.4 / 20 + 1e-6

    controller.process.send_signal(signal.SIGINT)
    ros.until(lambda: not any(twist(robot.commands[-1])), "the last command")
    assert controller.wait() == 0


def test_the_map_is_the_policys_and_odometry_moves_it(ros: Ros) -> None:
    from geometry_msgs.msg import TwistStamped
    from nav_msgs.msg import OccupancyGrid, Odometry

    maps: list[Any] = []
    robot = Robot(ros, TwistStamped)
    ros.node.create_subscription(OccupancyGrid, "map", maps.append, 10)
    odometry = ros.node.create_publisher(Odometry, "odom", 10)
    controller = ros.start("controller", weights="near", publish_map=True, use_odom=True, scan_timeout=5.0)
    scan = scan_message(scene())
    robot.send_until(scan, moving=True)
    ros.until(lambda: bool(maps), "the map")
    seen = maps[-1]
    assert (seen.header.frame_id, seen.info.width, seen.info.height) == ("base_link", 100, 100)
    assert (seen.info.origin.position.x, seen.info.origin.position.y) == (-2.0, -2.0)
    # A message counts its cells along x first.
    shown = np.array(seen.data).reshape(100, 100).T
    np.testing.assert_array_equal(shown, 100 * occupancy_maps(Scan(scene(), GRID), MapConfig()))

    def report(x: float) -> None:
        message = Odometry()
        message.header.stamp = ros.node.get_clock().now().to_msg()
        message.pose.pose.position.x, message.pose.pose.orientation.w = x, 1.0
        odometry.publish(message)

    def hit(cells: Any) -> float:
        """How far ahead the farthest occupied cell is [m]."""
        columns, _ = np.nonzero(np.array(cells.data).reshape(100, 100).T)
        return 0.04 * int(columns.max()) - 2

    def drive() -> bool:
        """The robot is moved 0.4 m ahead after its last scan, and stays there."""
        for x in (0.0, 0.0, 0.1, 0.2, 0.3, 0.4):
            if x == 0.0:
                robot.send(scan, 0.1)
            report(x)
            ros.listen(0.1)
        maps.clear()
        for _ in range(4):
            report(0.4)
            ros.listen(0.1)
        return bool(maps) and hit(maps[-1]) == pytest.approx(hit(seen) - 0.4, abs=0.1)

    ros.until(drive, "the map that has moved")
    assert controller.end(signal.SIGTERM) == 0


@pytest.mark.parametrize(
    ("name", "parameters", "told"),
    [
        ("controller", {"distance": 99.0}, "'distance' cannot be used"),
        ("controller", {"distance": 1}, "a number with a decimal point between 0.05 and 4 is needed"),
        ("controller", {"rays": 5}, "'rays' cannot be used"),
        ("controller", {"distnce": 1.0}, "there is no parameter 'distnce'"),
        ("controller", {"controller": "expert"}, "needs everybody's true pose"),
        ("controller", {"profile": "turtlebot5"}, "there is no profile 'turtlebot5'"),
        ("gazebo_bridge", {"simulator": "stage"}, "there is no simulator 'stage'"),
        ("gazebo_bridge", {"profile": "turtlebot4"}, "has a differential base, and Gazebo drives holonomic robots"),
        ("gazebo_bridge", {"robots": 0}, "'robots' cannot be used"),
    ],
)
def test_bad_parameters_are_refused_in_one_sentence(ros: Ros, name: str, parameters: dict[str, Any], told: str) -> None:
    refused: Executable = ros.start(name, **parameters)
    assert refused.wait() == 1
    lines = refused.log.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("triform: ")
    assert told in lines[0]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["-p", "distance"], "'-p distance'"),
        (["-r", "__ns:=two words"], "'-r __ns:=two words'"),
        (["--params-file", "/proc/none.yaml"], "Error opening YAML file"),
        (["-p", "footprint:=[]"], "PARAMETER_NOT_SET"),
    ],
)
def test_arguments_that_ros_cannot_read_are_refused_in_one_sentence(ros: Ros, arguments: list[str], told: str) -> None:
    refused = ros.start("controller", *arguments)
    assert refused.wait() == 1
    # What comes before is ROS's own.
    own = [line for line in refused.log.strip().splitlines() if "[rcl]" not in line]
    assert len(own) == 1
    assert own[0].startswith("triform: ROS cannot use the arguments: ")
    assert told in own[0]
