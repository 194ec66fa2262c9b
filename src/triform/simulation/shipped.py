"""Shipped robot profiles, with the source of every number, and where they are looked up.

Accuracies of data sheets are read as two standard deviations, as those of the hardware profile are. What no source says
is called an assumption. A circle is the smallest one around the middle of the axle that holds the robot, because it
turns about that. The LiDARs of TurtleBots sit on top of them: robots see each other as these circles only if each wears
a collar of that diameter at the height of the LiDAR. From secondary sources, to be compared with the manual of a robot
before it drives: the turn rate and the LiDAR's rate of the TurtleBot 4, the track of its base, the ROSbot XL's outline.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from triform.geometry.footprint import Footprint
from triform.simulation.mounting import Mounting
from triform.simulation.profiles import HARDWARE, IDEAL, Drive, LidarConfig, NoiseBand, Profile
from triform.types import ScanConfig, choose, converted

#: ROBOTIS LDS-02, on TurtleBot3 since 2022 (e-manual, appendix LDS-02): 0.16 m to 8 m, 5 Hz or above, 1 degree;
#: +-10 mm up to 0.3 m, +-3 % beyond. Lost rays: an assumption.
LDS_02 = LidarConfig(
    scan=ScanConfig(rays=360, range_min=0.16),
    noise=(NoiseBand(0.3, absolute=0.005), NoiseBand(math.inf, relative=0.015)),
    dropout=0.01,
    rolling=True,
    period=1 / 5,
)

#: ROBOTIS LDS-01, on earlier ones (e-manual, appendix LDS-01): 0.12 m to 3.5 m, 300 turns per minute, 1 degree;
#: precision +-10 mm up to 0.5 m, +-3.5 % beyond. Lost rays: an assumption.
LDS_01 = replace(
    LDS_02,
    scan=ScanConfig(rays=360, range_min=0.12),
    noise=(NoiseBand(0.5, absolute=0.005), NoiseBand(math.inf, relative=0.0175)),
)

#: SLAMTEC RPLIDAR A1M8 (data sheet): 0.15 m to 12 m, 360 samples a turn, 1 % of the range, 5.5 to 10 Hz. That it turns
#: 7.7 times a second, and lost rays: assumptions. The intensities of its ROS driver are no measurement of brightness
#: (robopeak/rplidar_ros, issue 44; in Slamtec/rplidar_ros, issue 6, an A3 gives 47 for every return).
RPLIDAR_A1 = LidarConfig(
    scan=ScanConfig(rays=360, range_min=0.15),
    noise=(NoiseBand(math.inf, relative=0.005),),
    dropout=0.01,
    rolling=True,
    period=0.13,
    intensities=False,
)

#: SLAMTEC RPLIDAR A2M12 (data sheet): 0.2 m to 12 m, 16,000 samples a second at 10 Hz, 1 % of the range. Lost rays: an
#: assumption.
RPLIDAR_A2 = replace(
    RPLIDAR_A1,
    scan=ScanConfig(rays=1600, range_min=0.2),
    period=1 / 10,
)

#: Speeds of ROBOTIS's TurtleBot3 Burger: e-manual, "Specifications"; no wheel is faster than when both drive straight.
#: Track, wheels, outline and place of the LiDAR: turtlebot3_burger.urdf. Accelerations, lag, latency: assumptions.
BURGER = Profile(
    "turtlebot3-burger",
    Footprint.circle(0.25),
    LDS_02,
    Drive(
        max_speed=0.22,
        max_turn_rate=2.84,
        max_acceleration=1.0,
        max_turn_acceleration=12.5,
        lag=0.05,
        kind="differential",
        track=0.16,
        max_wheel_speed=0.22,
        wheel_radius=0.033,
    ),
    latency=0.05,
    mounting=Mounting(x=-0.032),
)

#: The same of the TurtleBot3 Waffle and Waffle Pi: e-manual, turtlebot3_waffle_pi.urdf.
WAFFLE = replace(
    BURGER,
    name="turtlebot3-waffle",
    footprint=Footprint.circle(0.49),
    drive=replace(
        BURGER.drive,
        max_speed=0.26,
        max_turn_rate=1.82,
        max_turn_acceleration=6.9,
        track=0.288,
        max_wheel_speed=0.26,
    ),
    mounting=Mounting(x=-0.064),
)

#: Clearpath's TurtleBot 4: an iRobot Create 3, 342 mm across. Speed with its safety features, largest speed and largest
#: acceleration of a wheel: create3_docs, "Safety Overrides"; it backs up freely only if its `safety_override` is
#: `backup_only`. Turn rate: TurtleBot 4 manual, "Features". Track and wheels: irobot_create_description. Place of the
#: LiDAR: turtlebot4.urdf.xacro; its zero points to the left. Lag, latency: assumptions.
TURTLEBOT4 = Profile(
    "turtlebot4",
    Footprint.circle(0.342),
    RPLIDAR_A1,
    Drive(
        max_speed=0.306,
        max_turn_rate=1.9,
        max_acceleration=0.9,
        max_turn_acceleration=7.7,
        lag=0.1,
        kind="differential",
        track=0.233,
        max_wheel_speed=0.46,
        wheel_radius=0.03575,
    ),
    latency=0.1,
    mounting=Mounting(x=-0.04, yaw=math.pi / 2),
)

#: Husarion's ROSbot XL with mecanum wheels, 332 mm x 325 mm (manual). Turn rate and accelerations:
#: mecanum_drive_controller.yaml of rosbot_xl_ros. It could drive 0.9 m/s; here it has the 0.5 m/s of the ideal robots.
#: LiDAR on the middle of its cover: rosbot_xl.urdf.xacro. Lag, latency: assumptions.
ROSBOT_XL = Profile(
    "rosbot-xl",
    Footprint.box(0.332, 0.325),
    RPLIDAR_A2,
    Drive(max_speed=0.5, max_turn_rate=3.0, max_acceleration=1.0, max_turn_acceleration=4.0, lag=0.05),
    latency=0.05,
)

#: Profiles by name.
PROFILES = {
    profile.name: profile
    for profile in (
        IDEAL,
        HARDWARE,
        BURGER,
        replace(BURGER, name="turtlebot3-burger-lds01", lidar=LDS_01),
        WAFFLE,
        replace(WAFFLE, name="turtlebot3-waffle-lds01", lidar=LDS_01),
        TURTLEBOT4,
        ROSBOT_XL,
    )
}


def get_profile(name: str) -> Profile:
    """Return a profile by its name, or from a TOML file.

    Args:
        name: One of ``PROFILES``, or the path of a file that ends in ``.toml``.

    Raises:
        ConfigurationError: There is no such profile, or the file holds what is not allowed.
    """
    name = converted("profile", name, str)
    if name.endswith(".toml"):
        from triform.simulation.profile_file import read_profile

        return read_profile(Path(name))
    return choose("profile", name, PROFILES, " and your own as FILE.toml")
