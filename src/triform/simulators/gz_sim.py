"""Writes a team for modern Gazebo, gz-sim 8 (Harmonic) or later, and the bridge between its topics and those of ROS 2.

Robot ``k`` has the topics ``/robot<k>/scan``, ``/robot<k>/cmd_vel`` and ``/robot<k>/odom`` on both sides of the bridge.
A holonomic robot floats above the ground and takes the velocity that is commanded; a differential one drives on two
wheels and casters. A LiDAR does not see its own robot: the body of each robot has a bit of its own, which its LiDAR
masks.
"""

from __future__ import annotations

import math

import numpy as np

from triform.simulation import Arena, Mounting, Profile, noise_sigma
from triform.simulation.profiles import Drive
from triform.simulators.chassis import (
    BALL_RADIUS,
    CASTER_PLACE,
    CENTRE_OF_MASS,
    HEIGHT,
    LIDAR_HEIGHT,
    MASS,
    WALL_HEIGHT,
    WHEEL_HALF_WIDTH,
    WHEEL_MASS,
    braked,
    check_axle,
    moments_of_inertia,
)
from triform.simulators.sdf import cylinder, inertia, obstacles, outline, pose
from triform.types import FloatArray, require

#: Step of the physics [s].
_TIME_STEP = 0.002
#: What LiDARs see by default; the bits that gz-rendering keeps for its own window and for particles are no robot's.
_ALL = 0x0FFFFFFF
_ROBOT_BITS = [1 << bit for bit in range(2, 28) if bit != 20]
#: How far LiDARs look, beyond what a robot uses of it [m].
_REACH = 8.0
#: Odometry per second [Hz].
_ODOMETRY_RATE = 50
#: Clearance of a holonomic robot, and of a differential one's casters, whose wheels must touch the ground [m].
_CLEARANCE, _CASTER_CLEARANCE = 0.02, 0.0005
#: Topics of a robot: name, type in ROS 2, type in Gazebo, direction.
_TOPICS = (
    ("scan", "sensor_msgs/msg/LaserScan", "gz.msgs.LaserScan", "GZ_TO_ROS"),
    ("odom", "nav_msgs/msg/Odometry", "gz.msgs.Odometry", "GZ_TO_ROS"),
    ("cmd_vel", "geometry_msgs/msg/TwistStamped", "gz.msgs.Twist", "ROS_TO_GZ"),
)


def write_bridge(robots: int) -> str:
    """Return the configuration of ``ros_gz_bridge`` for a number of robots, and for the clock, as YAML."""
    entries = [_entry("/clock", "/world/triform/clock", "rosgraph_msgs/msg/Clock", "gz.msgs.Clock", "GZ_TO_ROS")]
    for robot in range(robots):
        for name, ros_type, gz_type, direction in _TOPICS:
            topic = f"/robot{robot}/{name}"
            entries.append(_entry(topic, topic, ros_type, gz_type, direction))
    return "".join(entries)


def write_gz_world(profile: Profile, arena: Arena, poses: FloatArray) -> str:
    """Return an SDF world with a ground, an arena and robots.

    Args:
        profile: Kind of all robots. Of its LiDAR's errors there is the noise at 1 m; Gazebo measures all rays at once.
        arena: Walls, which become boxes ``WALL_THICKNESS`` thick, and pillars.
        poses: Where the robots start, in the world frame, shape (N, 3) [m, m, rad].

    Raises:
        ConfigurationError: More robots than LiDARs can tell from each other, or wheels that do not fit.
    """
    most = len(_ROBOT_BITS)
    require(len(poses) <= most, f"{len(poses)} robots; LiDARs in a world of Gazebo tell at most {most} from each other")
    if profile.drive.is_differential:
        check_axle(profile)
    ground = "<plane><normal>0 0 1</normal><size>100 100</size></plane>"
    return f"""<?xml version="1.0"?>
<sdf version="1.9"><world name="triform">
  <physics name="physics" type="ignored">
    <max_step_size>{_TIME_STEP}</max_step_size><real_time_factor>1</real_time_factor>
  </physics>
  {_plugin("physics", "Physics")}
  {_plugin("user-commands", "UserCommands")}
  {_plugin("scene-broadcaster", "SceneBroadcaster")}
  {_plugin("sensors", "Sensors", "<render_engine>ogre2</render_engine>")}
  <light type="directional" name="sun"><direction>-0.5 0.1 -0.9</direction></light>
  <model name="ground"><static>true</static>
    <link name="link">{_collision("ground", ground, 0.0, 1.0)}{_visual("ground", ground, 0.0, "0.8 0.8 0.8")}</link>
  </model>
  {"".join(_obstacle(*each) for each in obstacles(arena))}
  {"".join(_robot(index, profile, *each) for index, each in enumerate(poses.tolist()))}
</world></sdf>
"""


def _entry(ros_topic: str, gz_topic: str, ros_type: str, gz_type: str, direction: str) -> str:
    return f"""- ros_topic_name: {ros_topic}
  gz_topic_name: {gz_topic}
  ros_type_name: {ros_type}
  gz_type_name: {gz_type}
  direction: {direction}
"""


def _plugin(library: str, name: str, content: str = "") -> str:
    return f'<plugin filename="gz-sim-{library}-system" name="gz::sim::systems::{name}">{content}</plugin>'


def _elements(**values: object) -> str:
    return "".join(f"<{name}>{value}</{name}>" for name, value in values.items())


def _collision(name: str, shape: str, height: float, friction: float, x: float = 0.0) -> str:
    return f"""<collision name="{name}">{pose(x, 0.0, height)}<geometry>{shape}</geometry>
      <surface><friction><ode><mu>{friction}</mu><mu2>{friction}</mu2></ode></friction></surface>
    </collision>"""


def _visual(name: str, shape: str, height: float, colour: str, flags: int = _ALL) -> str:
    return f"""<visual name="{name}">{pose(0.0, 0.0, height)}<geometry>{shape}</geometry>
      <material><ambient>{colour} 1</ambient><diffuse>{colour} 1</diffuse></material>
      <visibility_flags>{flags}</visibility_flags>
    </visual>"""


def _obstacle(name: str, place: tuple[float, float, float], shape: str) -> str:
    x, y, heading = place
    return f"""<model name="{name}"><static>true</static>{pose(x, y, WALL_HEIGHT / 2, heading)}
    <link name="link">{_collision(name, shape, 0.0, 0.0)}{_visual(name, shape, 0.0, "0.5 0.5 0.5")}</link>
  </model>"""


def _robot(index: int, profile: Profile, x: float, y: float, heading: float) -> str:
    drive, footprint, name = braked(profile.drive), profile.footprint, f"robot{index}"
    wheels = drive.is_differential
    clearance = drive.wheel_radius if wheels else _CLEARANCE
    mass = MASS - 2 * WHEEL_MASS if wheels else MASS
    shape, middle = outline(footprint, HEIGHT - clearance), (HEIGHT + clearance) / 2
    place = CASTER_PLACE * footprint.half_length
    ball = f"<sphere><radius>{BALL_RADIUS}</radius></sphere>"
    casters = (("front", place), ("rear", -place)) if wheels else ()
    return f"""<model name="{name}">{pose(x, y, 0.0, heading)}
    <link name="base_link">
      {inertia(mass, CENTRE_OF_MASS, moments_of_inertia(footprint, mass))}
      {_collision("body", shape, middle, 0.0)}{_visual("body", shape, middle, "0 0.45 0.7", _ROBOT_BITS[index])}
      {"".join(_collision(each, ball, BALL_RADIUS + _CASTER_CLEARANCE, 0.0, at) for each, at in casters)}
      {_lidar(name, profile, _ALL & ~_ROBOT_BITS[index])}
      {_elements(gravity=str(wheels).lower())}
    </link>
    {_axle(name, drive) if wheels else _floating(name)}
  </model>"""


def _lidar(name: str, profile: Profile, mask: int) -> str:
    """Return the LiDAR as it is mounted, whose own first ray points backwards."""
    mounting: Mounting = profile.mounting
    lidar, rays = profile.lidar, profile.lidar.scan.rays
    roll = 0.0 if mounting.upright else math.pi
    horizontal = _elements(samples=rays, resolution=1, min_angle=-math.pi, max_angle=math.pi - 2 * math.pi / rays)
    sigma = float(noise_sigma(np.ones(1), lidar.noise)[0])
    return f"""<sensor name="lidar" type="gpu_lidar">
        <pose>{mounting.x} {mounting.y} {LIDAR_HEIGHT} {roll} 0 {mounting.yaw}</pose>
        {_elements(topic=f"/{name}/scan", update_rate=1 / lidar.period, always_on="true")}
        <lidar>
          <scan><horizontal>{horizontal}</horizontal></scan>
          <range>{_elements(min=lidar.scan.range_min, max=_REACH, resolution=0.001)}</range>
          <noise>{_elements(type="gaussian", mean=0, stddev=sigma)}</noise>
          {_elements(visibility_mask=mask)}
        </lidar>
      </sensor>"""


def _floating(name: str) -> str:
    """Return what moves a holonomic robot, and tells its way."""
    odometry = _elements(
        odom_topic=f"/{name}/odom",
        odom_frame=f"{name}/odom",
        robot_base_frame=f"{name}/base_link",
        odom_publish_frequency=_ODOMETRY_RATE,
        dimensions=2,
    )
    return _plugin("velocity-control", "VelocityControl", _elements(topic=f"/{name}/cmd_vel")) + _plugin(
        "odometry-publisher", "OdometryPublisher", odometry
    )


def _axle(name: str, drive: Drive) -> str:
    """Return the two wheels of a differential robot, and what turns them and tells their way."""
    radius, moment = drive.wheel_radius, 0.5 * WHEEL_MASS * drive.wheel_radius**2
    shape = cylinder(radius, 2 * WHEEL_HALF_WIDTH)
    wheels = "".join(
        f"""<link name="{side}_wheel">
      <pose>0 {left * drive.track / 2} {radius} {-math.pi / 2} 0 0</pose>
      {inertia(WHEEL_MASS, 0.0, (moment, moment, moment))}{_collision("tyre", shape, 0.0, 1.0)}
    </link>
    <joint name="{side}_axle" type="revolute">
      <parent>base_link</parent><child>{side}_wheel</child><axis><xyz>0 0 1</xyz></axis>
    </joint>"""
        for side, left in (("left", 1), ("right", -1))
    )
    limits = {
        "linear_velocity": min(drive.max_speed, drive.max_axis_speed),
        "angular_velocity": drive.max_turn_rate,
        "linear_acceleration": drive.max_acceleration,
        "angular_acceleration": drive.max_turn_acceleration,
    }
    content = _elements(
        left_joint="left_axle",
        right_joint="right_axle",
        wheel_separation=drive.track,
        wheel_radius=radius,
        topic=f"/{name}/cmd_vel",
        odom_topic=f"/{name}/odom",
        frame_id=f"{name}/odom",
        child_frame_id=f"{name}/base_link",
        odom_publish_frequency=_ODOMETRY_RATE,
        **{f"max_{limit}": value for limit, value in limits.items()},
        **{f"min_{limit}": -value for limit, value in limits.items()},
    )
    return wheels + _plugin("diff-drive", "DiffDrive", content)
