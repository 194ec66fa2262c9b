"""What the parameters of ``controller`` say: a robot, as a profile, and how it is driven."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from triform.control import (
    ControllerSpec,
    SafetySettings,
    bright_returns,
    make_controller,
    sight_of,
    weights_folder,
)
from triform.control.detection import kernel_footprint
from triform.policy import read_spec
from triform.robots.filter import from_scans_alone, safety_settings
from triform.simulation import IDEAL, Drive, Footprint, Mounting, Placement, Profile, get_profile, read_sectors
from triform.types import Controller, MapConfig, ScanConfig, View, require
from triform_ros.parameters import Parameter

#: A robot without a profile: the ideal one, whose scans may be 0.2 s late.
UNKNOWN_ROBOT = replace(IDEAL, name="", latency=0.2)
#: Parameters that say how the LiDAR is mounted; one that is given keeps transforms from being asked.
MOUNTING = frozenset({"mounting", "lidar_position", "upside_down"})
#: Limits of commands for holonomic robots, and for profiles that have none [rad/s, m/s^2, rad/s^2].
_TURN_RATE, _ACCELERATION, _TURN_ACCELERATION = 1.0, 2.0, 5.0


def wants_stamped(distribution: str | None) -> bool:
    """Tell whether robots of a distribution of ROS 2 take ``TwistStamped``: from Jazzy on; names are alphabetical."""
    return distribution is None or distribution >= "jazzy"


def profile_of(name: str) -> Profile:
    """Return the profile of a name or a TOML file; that of an unknown robot if empty.

    Raises:
        ConfigurationError: There is no such profile, or the file holds what is not allowed.
    """
    return get_profile(name) if name else UNKNOWN_ROBOT


def parameters(name: str) -> tuple[Parameter, ...]:
    """Return all parameters of ``controller``, with the defaults of a profile.

    Args:
        name: See ``profile_of``.

    Raises:
        ConfigurationError: There is no such profile.
    """
    robot = profile_of(name)
    drive, mounting, outline = robot.drive, robot.mounting, robot.footprint
    size = [outline.length] if outline.is_circle else [outline.length, outline.width]
    sectors = " ".join(f"{begin:g}:{end:g}" for begin, end in mounting.blind_sectors)
    turn_rate = drive.max_turn_rate if drive.is_differential else _TURN_RATE
    threshold = robot.lidar.min_intensity or 0.0
    yaw = math.remainder(mounting.yaw, math.tau)
    stamped = wants_stamped(os.environ.get("ROS_DISTRO"))
    return (
        Parameter("profile", "", "Robot profile, whose values are the defaults of the others: a name or a TOML file"),
        Parameter("distance", 1.0, "Prescribed neighbour distance d*, equal on all robots [m]", 0.05, 4.0, live=True),
        Parameter("controller", "policy", "One that needs only scans: policy, scan-pipeline, scan-triangulating"),
        Parameter("weights", "", "Weights of policy: a name of shipped ones or a folder; empty for the default ones"),
        Parameter("enabled", True, "Whether the robot drives; otherwise its commands are zero", live=True),
        Parameter("control_rate", 1 / robot.control_period, "Commands per second [Hz]", 1.0, 100.0),
        Parameter("scan_timeout", 0.5, "The robot stands while its newest scan is older [s]", 0.05, 5.0, live=True),
        Parameter("rays", robot.lidar.scan.rays, "Rays of the full turn that scans are brought onto", 90, 7200),
        Parameter("mounting", yaw, "Direction of the LiDAR's x axis on the robot [rad]", -math.pi, math.pi),
        Parameter("lidar_position", [mounting.x, mounting.y], "Where the LiDAR is, forward and left of the centre [m]"),
        Parameter("upside_down", not mounting.upright, "Whether the LiDAR hangs upside down"),
        Parameter("tf_timeout", 5.0, "How long to wait for /tf_static to say how the LiDAR is mounted [s]", 0.0, 60.0),
        Parameter("blind_sectors", sectors, "Where only the robot itself is, as FROM:TO in degrees, with spaces"),
        Parameter("min_intensity", threshold, "Intensity of a robot's tape; 0: not asked", 0.0, 1e6, live=True),
        Parameter("scan_frame", "", "Frame that scans must be in; empty for any"),
        Parameter("base_frame", "base_link", "The robot's own frame, in which commands, maps and markers are"),
        Parameter("use_odom", name != "" and robot.odometry, "Whether to use the odometry on odom"),
        Parameter("drive", drive.kind, "Kind of base: holonomic or differential, two driven wheels"),
        Parameter("max_speed", drive.max_speed, "Largest speed [m/s]", 0.01, 3.5, live=True),
        Parameter("max_axis_speed", _no_limit(drive.max_axis_speed), "Along x and along y; 0: none [m/s]", 0.0, 3.5),
        Parameter("max_turn_rate", turn_rate, "Largest turn rate [rad/s]", 0.01, 10.0, live=True),
        Parameter(
            "max_acceleration", _finite(drive.max_acceleration, _ACCELERATION),
            "Largest acceleration of commands; braking is never delayed [m/s^2]", 0.05, 100.0, live=True,
        ),
        Parameter(
            "max_turn_acceleration", _finite(drive.max_turn_acceleration, _TURN_ACCELERATION),
            "The same for turning [rad/s^2]", 0.05, 100.0, live=True,
        ),
        Parameter("lag", drive.lag, "Time constant of the base [s]", 0.0, 2.0),
        Parameter("track", drive.track, "Of a differential base: distance between its wheels [m]", 0.0, 5.0),
        Parameter("max_wheel_speed", _no_limit(drive.max_wheel_speed), "Of one wheel; 0: none [m/s]", 0.0, 10.0),
        Parameter("reverse", drive.reverse, "Whether a differential base may drive backwards"),
        Parameter("stamped", stamped, "Whether commands are TwistStamped and not Twist"),
        Parameter("publish_map", False, "Whether to publish the map that the policy sees on map", live=True),
        Parameter("guard", True, "Whether the safety filter keeps the robot from what its scan shows", live=True),
        Parameter("reaction", 0.0, "Greatest age of a measurement; 0: worked out [s]", 0.0, 5.0, live=True),
        Parameter("min_gap", SafetySettings().min_gap, "Gap that the filter keeps [m]", 0.0, 2.0, live=True),
        Parameter("footprint", size, "Length and width of the robots, or one diameter [m]"),
        Parameter("seed", 0, "Of the exploration noise; the node's full name goes in too", 0, 2**31 - 1),
    )  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """One set of values of the parameters, checked when made.

    Attributes:
        given: Values of the parameters by name.
        found: The mounting that transforms tell; that of the parameters if ``None``.
    """

    given: Mapping[str, Any]
    found: Mounting | None = None

    def __post_init__(self) -> None:
        _ = self.robot, self.filter

    @property
    def spec(self) -> ControllerSpec:
        """The controller."""
        name, weights = self.given["controller"], self.given["weights"]
        return ControllerSpec.parse(f"{name}:{weights}" if weights else name)

    @cached_property
    def robot(self) -> Profile:
        """The robot, whose scans are as rich as the parameters want them, and reach as far as its controller looks."""
        given = self.given
        outline = given["footprint"]
        require(len(outline) in (1, 2), f"footprint has {len(outline)} numbers; length and width, or a diameter, do")
        profile = profile_of(given["profile"])
        drive = replace(
            profile.drive,
            kind=given["drive"],
            **{name: given[name] for name in ("max_speed", "max_turn_rate", "lag", "track", "reverse")},
            **{name: given[name] or math.inf for name in ("max_axis_speed", "max_wheel_speed")},
        )
        scan = replace(profile.lidar.scan, rays=given["rays"], range_max=sight_of(self.spec) * given["distance"])
        return replace(
            profile,
            footprint=Footprint.circle(*outline) if len(outline) == 1 else Footprint.box(*outline),
            lidar=replace(profile.lidar, scan=scan, min_intensity=given["min_intensity"] or None),
            drive=drive,
            control_period=1 / given["control_rate"],
            odometry=given["use_odom"],
            mounting=self.found or _mounting(given),
        )

    @cached_property
    def filter(self) -> SafetySettings:
        """Settings of the safety filter."""
        return replace(safety_settings(self.robot, self.given["reaction"] or None), min_gap=self.given["min_gap"])

    @property
    def scan(self) -> ScanConfig:
        """Shape of the scans that controllers see."""
        return self.robot.lidar.scan

    @property
    def placement(self) -> Placement:
        """What brings turns of the LiDAR into the robot's frame."""
        return Placement(self.scan, self.robot.mounting, kernel_footprint(self.robot.footprint.size))

    @property
    def command_limits(self) -> Drive:
        """How fast commands may change: what the robot's base can do, or less."""
        accelerations = {name: self.given[name] for name in ("max_acceleration", "max_turn_acceleration")}
        return replace(self.robot.drive, **accelerations)

    @property
    def policy_map(self) -> tuple[float, MapConfig]:
        """Reach [m] and shape of the map that the policy sees; the paper's, scaled to d*, for others."""
        given, scan = self.given, self.scan
        if given["controller"] == "policy":
            used, config = read_spec(weights_folder(given["weights"] or None)).views(scan, given["distance"])
            return used.range_max, config
        return scan.range_max, replace(MapConfig(), cell=MapConfig().cell * given["distance"])

    def make_controller(self) -> Controller[View]:
        """Make the controller, without its safety filter.

        Raises:
            TriformError: There is no such controller, it needs what no robot knows, or its weights cannot be used.
        """
        controller = make_controller(
            self.spec,
            self.given["distance"],
            footprint=self.robot.footprint.size,
            noise=self.robot.lidar.largest_noise,
        )
        return from_scans_alone(controller, self.given["controller"], self.robot.lidar.min_intensity)

    def seen(self, view: View) -> View:
        """Return what the controller sees of a view: with ``min_intensity``, no dim returns."""
        threshold = self.robot.lidar.min_intensity
        return view if threshold is None else replace(view, scans=bright_returns(view.scans, threshold))


def _mounting(given: Mapping[str, Any]) -> Mounting:
    """Return how the parameters say that the LiDAR is mounted."""
    position = given["lidar_position"]
    require(len(position) == 2, f"lidar_position has {len(position)} numbers; forward and left of the centre, two, do")
    return Mounting(*position, given["mounting"], not given["upside_down"], read_sectors(given["blind_sectors"]))


def _no_limit(value: float) -> float:
    """Return a limit as parameters have it: 0 for none."""
    return value if value < math.inf else 0.0


def _finite(value: float, otherwise: float) -> float:
    return value if value < math.inf else otherwise
