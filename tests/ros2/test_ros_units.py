"""Conversions, settings and markers of the ROS 2 package, without any process beside."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.ros2.conftest import PACKAGE
from triform.control import limit_by_scans
from triform.robots.filter import safety_settings
from triform.robots.frames import FrameTree, mounting_of
from triform.simulation import PROFILES, Mounting, World, get_profile, integrate
from triform.types import Scan, TriformError, View

pytestmark = pytest.mark.skipif(find_spec("rclpy") is None, reason="rclpy is missing; the extra ros has it")


@pytest.fixture(autouse=True)
def _package(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(PACKAGE))
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        yield


def defaults(robot: str, **changed: Any) -> dict[str, Any]:
    """Values of the parameters for a robot of a profile of which nothing else is given."""
    from triform_ros.settings import parameters

    return {each.name: each.default for each in parameters(robot)} | {"profile": robot} | changed


angles = st.floats(-math.pi, math.pi)


@settings(deadline=None, max_examples=30)
@given(angles, st.booleans(), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_a_mounting_survives_its_transform_and_a_scan_its_message(
    yaw: float, upright: bool, x: float, y: float
) -> None:
    from triform_ros.conversions import laser_scan, mounting_transform, numbers_of, scan_message

    mounting = Mounting(x, y, yaw, upright)
    message = mounting_transform(mounting, "base", "laser")
    tree = FrameTree()
    tree.add(message.header.frame_id, message.child_frame_id, *numbers_of(message.transform))
    pose = tree.pose("laser", "base")
    assert pose is not None
    found = mounting_of(pose)
    assert (found.upright, found.x, found.y) == (upright, pytest.approx(x), pytest.approx(y))
    assert abs(math.remainder(found.yaw - yaw, 2 * math.pi)) < 1e-9

    config = get_profile("turtlebot4").from_lidar
    ranges = np.random.default_rng(3).uniform(0.5, 2.0, config.rays).astype(np.float32)
    for bright in (None, 100 * ranges):
        back = laser_scan(scan_message(ranges, bright, config, mounting, 0.13, rolling=True)).mounted(found)
        np.testing.assert_array_equal(back.on_grid(config), ranges)
        levels = back.intensities_on_grid(config)
        assert (levels is None) == (bright is None)
        if bright is not None:
            np.testing.assert_array_equal(levels, bright)


@pytest.mark.parametrize("name", PROFILES)
def test_the_defaults_of_a_profile_make_its_robot_and_its_filter(name: str) -> None:
    """What the parameters can say comes back; a scenario's filter is the controller's."""
    from triform_ros.settings import Settings

    profile, given_values = get_profile(name).seeing(3.0), defaults(name)
    robot = Settings(given_values).robot
    turn_rate = profile.drive.max_turn_rate if profile.drive.is_differential else 1.0
    assert robot == replace(
        profile, drive=replace(profile.drive, max_turn_rate=turn_rate), control_period=1 / (1 / profile.control_period)
    )
    assert Settings(given_values).filter == safety_settings(robot)
    slower = Settings({**given_values, "max_speed": 0.1, "reaction": 0.3, "min_gap": 0.2})
    assert (slower.filter.max_speed, slower.filter.reaction, slower.filter.min_gap) == (0.1, 0.3, 0.2)
    assert slower.robot.drive.max_speed == 0.1


def test_without_a_profile_a_robot_is_holonomic_and_its_reaction_that_of_the_filter() -> None:
    from triform_ros.settings import Settings

    made = Settings(defaults(""))
    assert (made.robot.name, made.robot.drive.kind, made.robot.odometry) == ("", "holonomic", False)
    assert made.filter.reaction == pytest.approx(0.4)
    rolling = Settings(defaults("", drive="differential", track=0.2, max_wheel_speed=0.4))
    assert rolling.filter.arcs is not None
    assert rolling.filter.arcs.wheels.half_track == 0.1


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"footprint": [0.3, 0.2, 0.1]}, "footprint has 3 numbers"),
        ({"footprint": [-0.3]}, "both must be positive"),
        ({"lidar_position": [0.1]}, "lidar_position has 1 numbers"),
        ({"blind_sectors": "10-20"}, "the blind sector '10-20' is no FROM:TO"),
        ({"drive": "tracked"}, "kind is 'tracked'; allowed are holonomic, differential"),
        ({"controller": "expert"}, "needs everybody's true pose"),
        ({"controller": "pilot"}, "there is no controller 'pilot'"),
        ({"weights": "none"}, "there is no policy 'none'"),
        ({"profile": "turtlebot"}, "there is no profile 'turtlebot'"),
    ],
)
def test_settings_are_refused_when_made(changed: dict[str, Any], told: str) -> None:
    from triform_ros.settings import Settings

    with pytest.raises(TriformError, match=told):
        Settings(defaults("", **changed)).make_controller()


@pytest.mark.parametrize(
    ("distribution", "stamped"),
    [(None, True), ("humble", False), ("iron", False), ("jazzy", True), ("kilted", True), ("rolling", True)],
)
def test_commands_are_stamped_from_jazzy_on(distribution: str | None, stamped: bool) -> None:
    from triform_ros.settings import wants_stamped

    assert wants_stamped(distribution) == stamped


def seen(name: str, others: list[list[float]], odometry: np.ndarray | None = None) -> View:
    """What a robot at the origin sees of others around it, late in a run."""
    profile = get_profile(name)
    poses = np.array([[[0.0, 0.0, 0.0], *([x, y, 0.0] for x, y in others)]])
    world = World(poses, replace(profile, lidar=replace(profile.lidar, noise=(), dropout=0.0)))
    world.apply(np.zeros_like(poses), 1.0)
    scan = world.observe().scans.ranges[:, :1]
    moved = None if odometry is None else odometry[None, None]
    return View(Scan(scan, profile.lidar.scan), np.ones((1, 1), dtype=bool), 10.0, odometry=moved)


def test_neighbours_are_where_they_are_from_where_the_robot_has_come_to() -> None:
    from triform_ros.markers import neighbours

    others = [[1.0, 0.2], [-0.3, 0.9]]
    for odometry in (None, np.array([0.2, -0.1, 0.7])):
        found = neighbours(seen("rosbot-xl", others, odometry), get_profile("rosbot-xl").footprint.size)
        place = np.zeros(3) if odometry is None else odometry
        cos, sin = np.cos(place[2]), np.sin(place[2])
        expected = (np.array(others) - place[:2]) @ np.array([[cos, -sin], [sin, cos]])
        order = [np.linalg.norm(found - each, axis=1).argmin() for each in expected]
        np.testing.assert_allclose(found[order], expected, atol=0.05)


@pytest.mark.parametrize("name", ["rosbot-xl", "turtlebot4"])
def test_what_is_drawn_as_allowed_the_filter_allows_and_nothing_beyond(name: str) -> None:
    """Each point of the border passes the filter; a little farther out it does not, unless at full speed."""
    from triform_ros.markers import allowed_velocities

    profile = get_profile(name)
    rules = safety_settings(profile)
    view = seen(name, [[0.6, 0.0], [-0.2, 0.7]], np.zeros(3))
    border = allowed_velocities(view, rules)
    speeds = np.hypot(*border.T)
    assert speeds.max() <= profile.drive.max_speed + 1e-9
    assert border[:, 0].max() < 0.9 * profile.drive.max_speed
    assert -border[:, 0].min() > border[:, 0].max()

    def filtered(x: float, y: float) -> np.ndarray:
        command = np.array([[[x, y, 0.0]]])
        return limit_by_scans(view, command, rules)[0, 0, :2]

    for x, y in border:
        np.testing.assert_allclose(filtered(x, y), [x, y], atol=1e-9)
        if 1e-6 < np.hypot(x, y) < 0.999 * profile.drive.max_speed:
            assert np.hypot(*(filtered(1.01 * x, 1.01 * y) - [1.01 * x, 1.01 * y])) > 1e-6


def test_the_way_of_a_command_is_that_of_the_base() -> None:
    from triform_ros.markers import way_of

    twist = np.array([0.3, 0.1, 0.8])
    way = way_of(twist)
    np.testing.assert_allclose(way[-1], integrate(np.zeros(3), twist, 1.0)[:2])
    np.testing.assert_allclose(way[5], integrate(np.zeros(3), twist, 0.5)[:2])
