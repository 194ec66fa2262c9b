"""Worlds for modern Gazebo, which is not here to read them: what they say, and that the bridge says the same."""

from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from triform.simulation import ARENAS, HARDWARE, IDEAL, PROFILES, Mounting, get_arena, get_profile, sample_starts
from triform.simulators.gz_sim import write_bridge, write_gz_world
from triform.types import ConfigurationError

yaml = pytest.importorskip("yaml")

START = sample_starts(3, 1, 7)[0]


def world(profile=IDEAL, arena="open", poses=START):
    return ET.fromstring(write_gz_world(profile, get_arena(arena), poses)).find("world")


def robots(root):
    return [model for model in root.iter("model") if model.get("name").startswith("robot")]


def numbers(element, path):
    return np.array([float(word) for word in element.find(path).text.split()])


@pytest.mark.parametrize("arena", ARENAS)
@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)
def test_robots_start_where_they_should_among_all_obstacles(profile, arena):
    root, obstacles = world(profile, arena), get_arena(arena)
    found = np.array([numbers(model, "pose") for model in robots(root)])
    np.testing.assert_allclose(found[:, [0, 1, 5]], START)
    np.testing.assert_array_equal(found[:, 2:5], 0.0)
    names = [model.get("name") for model in root.iter("model")]
    assert len(set(names)) == len(names) == 1 + len(obstacles.walls) + len(obstacles.pillars) + len(START)


@pytest.mark.parametrize("name", ["ideal", "turtlebot4"])
def test_the_bridge_joins_the_topics_of_the_world_with_those_of_controllers(name):
    root, entries = world(get_profile(name)), yaml.safe_load(write_bridge(len(START)))
    clock, *entries = entries
    assert (clock["ros_topic_name"], clock["gz_topic_name"]) == ("/clock", f"/world/{root.get('name')}/clock")
    topics = {(each["gz_topic_name"], each["direction"]) for each in entries}
    drive = "DiffDrive" if name == "turtlebot4" else "VelocityControl"
    expected = set()
    for model in robots(root):
        plugins = {each.get("name").split("::")[-1]: each for each in model.iter("plugin")}
        odometry = plugins.get("OdometryPublisher", plugins.get("DiffDrive"))
        expected |= {
            (model.find(".//sensor/topic").text, "GZ_TO_ROS"),
            (odometry.find("odom_topic").text, "GZ_TO_ROS"),
            (plugins[drive].find("topic").text, "ROS_TO_GZ"),
        }
    assert topics == expected
    # What controllers in the namespaces robot0, robot1, ... listen to and publish.
    assert {each["ros_topic_name"] for each in entries} == {
        f"/robot{k}/{topic}" for k in range(len(START)) for topic in ("scan", "odom", "cmd_vel")
    }
    types = {each["ros_topic_name"].split("/")[-1]: each["ros_type_name"] for each in entries}
    assert types == {
        "scan": "sensor_msgs/msg/LaserScan",
        "odom": "nav_msgs/msg/Odometry",
        "cmd_vel": "geometry_msgs/msg/TwistStamped",
    }


def test_lidars_see_all_but_their_own_robot():
    root = world(poses=np.array([(0.7 * k, 0.0, 0.0) for k in range(25)]))
    masks = [int(model.find(".//visibility_mask").text) for model in robots(root)]
    flags = [int(model.find(".//visibility_flags").text) for model in robots(root)]
    np.testing.assert_array_equal(np.bitwise_and.outer(masks, flags) != 0, ~np.eye(25, dtype=bool))
    obstacles = [int(each.text) for model in root.iter("model") for each in model.iter("visibility_flags")]
    assert all(mask & max(obstacles) for mask in masks)
    with pytest.raises(ConfigurationError, match=r"26 robots; .* at most 25"):
        world(poses=np.zeros((26, 3)))


@pytest.mark.parametrize("mounting", [Mounting(), Mounting(x=0.05, y=-0.02, yaw=2.0), Mounting(yaw=0.7, upright=False)])
def test_rays_leave_the_lidar_as_it_is_mounted(mounting):
    lidar = robots(world(replace(HARDWARE, mounting=mounting)))[0].find(".//sensor")
    x, y, _, roll, pitch, yaw = numbers(lidar, "pose")
    assert (x, y) == (mounting.x, mounting.y)
    count = int(lidar.find(".//samples").text)
    own = np.linspace(*(float(lidar.find(f".//{end}_angle").text) for end in ("min", "max")), count)
    assert own[1] - own[0] == pytest.approx(2 * np.pi / HARDWARE.lidar.scan.rays)
    rays = Rotation.from_euler("xyz", [roll, pitch, yaw]).apply(np.stack([np.cos(own), np.sin(own), 0 * own], axis=-1))
    expected = mounting.yaw + mounting.direction * own
    np.testing.assert_allclose(rays, np.stack([np.cos(expected), np.sin(expected), 0 * own], axis=-1), atol=1e-12)
    assert float(lidar.find("update_rate").text) == pytest.approx(6.0)


@pytest.mark.parametrize("name", [name for name, each in PROFILES.items() if each.drive.is_differential])
def test_differential_robots_stand_on_wheels_that_roll_forwards(name):
    profile = get_profile(name)
    drive, model = profile.drive, robots(world(profile))[0]
    plugin = next(each for each in model.iter("plugin") if each.get("name").endswith("DiffDrive"))
    assert float(plugin.find("wheel_separation").text) == drive.track
    assert float(plugin.find("wheel_radius").text) == drive.wheel_radius
    assert float(plugin.find("max_linear_velocity").text) == -float(plugin.find("min_linear_velocity").text)
    for side, left in (("left", 1), ("right", -1)):
        joint = next(each for each in model.iter("joint") if each.get("name") == plugin.find(f"{side}_joint").text)
        wheel = next(each for each in model.iter("link") if each.get("name") == joint.find("child").text)
        x, y, z, *angles = numbers(wheel, "pose")
        np.testing.assert_allclose([x, y, z], [0, left * drive.track / 2, drive.wheel_radius])
        turned = Rotation.from_euler("xyz", angles)
        # A cylinder stands along z; here it lies along the axle, about which a positive rate rolls forwards.
        np.testing.assert_allclose(turned.apply([0, 0, 1]), [0, 1, 0], atol=1e-9)
        np.testing.assert_allclose(turned.apply(numbers(joint, "axis/xyz")), [0, 1, 0], atol=1e-9)
    base = model.find("link")
    balls = [each for each in base.iter("collision") if each.find(".//sphere") is not None]
    assert [float(each.find(".//mu").text) for each in balls] == [0.0, 0.0]
    for ball in balls:
        x, _, z, *_ = numbers(ball, "pose")
        # Just above the ground, so that the wheels carry the robot, and under the body.
        assert 0 < z - float(ball.find(".//radius").text) < 1e-3
        assert 0.05 < abs(x) < profile.footprint.half_length
