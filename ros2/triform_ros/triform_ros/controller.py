"""The executable ``controller``: one robot, from its scans to its wheels, through Algorithm 2's loop."""

from __future__ import annotations

import math
import sys
import zlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rclpy.node import Node

from triform.control import ControllerSpec, SafetyFilter, SafetySettings, drive, make_controller, weights_folder
from triform.control.detection import ROBOMASTER_EP_SIZE, kernel_footprint
from triform.policy import read_spec
from triform.robots.real import RealRobot
from triform.simulation import Drive, Mounting, Placement, read_sectors
from triform.types import SENSING_RANGE, Controller, MapConfig, ScanConfig, TriformError, View, require
from triform_ros.executable import run_executable
from triform_ros.parameters import Parameter, declare
from triform_ros.robot import MapTopic, ScanTopic, TwistTopic

PARAMETERS = (
    Parameter("distance", 1.0, "Prescribed neighbour distance d*, the same on all robots [m]", 0.05, 4.0),
    Parameter("controller", "policy", "One that needs nothing but scans: policy, scan-pipeline, scan-triangulating"),
    Parameter("weights", "", "Weights of policy: a name of shipped ones or a folder; empty for the default ones"),
    Parameter("control_rate", 10.0, "Commands per second [Hz]", 1.0, 100.0),
    Parameter("scan_timeout", 0.5, "The robot stands while its newest scan is older than this [s]", 0.05, 5.0),
    Parameter("rays", 450, "Rays of the full turn that scans are brought onto; policies learned with 450", 90, 7200),
    Parameter("mounting", 0.0, "Angle of the LiDAR's x axis in the robot's frame [rad]", -math.pi, math.pi),
    Parameter("lidar_position", [0.0, 0.0], "Where the LiDAR is on the robot, forward and left of its centre [m]"),
    Parameter("upside_down", False, "Whether the LiDAR hangs upside down"),
    Parameter("blind_sectors", "", "Directions in which only the robot itself is, as FROM:TO in degrees, with spaces"),
    Parameter("scan_frame", "", "Frame that scans must be in; empty for any"),
    Parameter("base_frame", "base_link", "The robot's own frame, in which commands and maps are"),
    Parameter("use_odom", False, "Whether to allow for the way since a scan, which odometry on odom tells"),
    Parameter("max_speed", 0.5, "Largest speed [m/s]", 0.01, 3.5),
    Parameter("max_turn_rate", 1.0, "Largest turn rate [rad/s]", 0.01, 10.0),
    Parameter("max_acceleration", 2.0, "Largest acceleration; braking is never delayed [m/s^2]", 0.05, 100.0),
    Parameter("max_turn_acceleration", 5.0, "The same for turning [rad/s^2]", 0.05, 100.0),
    Parameter("lag", 0.0, "Time constant of the base; with use_odom, where it would come to rest counts [s]", 0.0, 2.0),
    Parameter("stamped", False, "Whether commands are TwistStamped and not Twist"),
    Parameter("publish_map", False, "Whether to publish the map that the policy sees on map"),
    Parameter("guard", True, "Whether the robot is kept from driving into what its scan shows"),
    Parameter("reaction", 0.4, "Greatest age of a measurement on which a command rests, for the guard [s]", 0.05, 5.0),
    Parameter("footprint", list(ROBOMASTER_EP_SIZE), "Length and width of the robots, or one diameter [m]"),
    Parameter("seed", 0, "Of the exploration noise; the node's full name goes in too", 0, 2**31 - 1),
)


class Controlled:
    """One robot with its parameters and topics."""

    def __init__(self, node: Node) -> None:
        """Declare, check and connect everything.

        Raises:
            TriformError: A parameter cannot be used.
        """
        self.node = node
        given = declare(node, PARAMETERS)
        outline = given["footprint"]
        require(len(outline) in (1, 2), f"footprint has {len(outline)} numbers; length and width, or a diameter, do")
        self._footprint = outline[0] if len(outline) == 1 else (outline[0], outline[1])
        scan = ScanConfig(rays=given["rays"], range_max=SENSING_RANGE * given["distance"])
        mounting = _mounting(given)
        limits = Drive(**{name: given[name] for name in given if name.startswith("max_")})
        period = 1 / given["control_rate"]
        self._controller = self._make_controller(given)
        self._scans = ScanTopic(
            node, replace(scan, range_max=scan.range_max + mounting.offset), mounting, given["scan_frame"]
        )
        self._wheels = TwistTopic(node, given["base_frame"], given["stamped"], given["use_odom"], limits, period)
        maps = _map_topic(node, given, scan) if given["publish_map"] else None
        self._robot = RealRobot(
            self._scans,
            self._wheels,
            period,
            # Robots that share their seed, as those of one parameter file do, differ in their names.
            (given["seed"] << 32) + zlib.crc32(node.get_fully_qualified_name().encode()),
            # The limits of acceleration are those of commands, and braking has none.
            replace(limits, max_acceleration=math.inf, max_turn_acceleration=math.inf, lag=given["lag"]),
            placement=Placement(scan, mounting, kernel_footprint(self._footprint)),
            odometry=given["use_odom"],
            scan_timeout=given["scan_timeout"],
            on_sent=None if maps is None else maps.publish,
            warn=node.get_logger().warning,
        )

    def run(self, check: Callable[[], None]) -> None:
        """Drive until an exception ends it, as that of ``check`` between two commands.

        Raises:
            TriformError: ROS has been shut down, or scans do not fit the controller.
        """
        self.node.get_logger().info(f"driving at {1 / self._robot.control_period:g} Hz")
        drive(self._robot, self._controller, math.inf, lambda *_: check())

    def stop(self) -> None:
        """Publish the last command, zero, and say what was received."""
        self._wheels.stop()
        scans = self._scans
        self.node.get_logger().info(
            f"received {scans.received} scans, refused {scans.refused}, lost {scans.lost}, "
            f"{self._robot.late_ticks} late commands"
        )

    def _make_controller(self, given: dict[str, Any]) -> Controller[View]:
        name, weights = given["controller"], given["weights"]
        spec = ControllerSpec.parse(f"{name}:{weights}" if weights else name)
        controller = make_controller(spec, given["distance"], footprint=self._footprint)
        if controller.privileged:
            raise TriformError(
                f"the controller {given['controller']!r} needs everybody's true pose, which no robot knows; "
                "policy, scan-pipeline and scan-triangulating need nothing but scans"
            )
        if not given["guard"]:
            return controller
        return SafetyFilter(
            controller, SafetySettings(self._footprint, reaction=given["reaction"], max_speed=given["max_speed"])
        )


def _mounting(given: dict[str, Any]) -> Mounting:
    position = given["lidar_position"]
    require(len(position) == 2, f"lidar_position has {len(position)} numbers; forward and left of the centre, two, do")
    return Mounting(*position, given["mounting"], not given["upside_down"], read_sectors(given["blind_sectors"]))


def _map_topic(node: Node, given: dict[str, Any], scan: ScanConfig) -> MapTopic:
    """The topic of the map that the policy sees; that of the paper, scaled to d*, if another controller drives."""
    used, config = scan, replace(MapConfig(), cell=MapConfig().cell * given["distance"])
    if given["controller"] == "policy":
        used, config = read_spec(weights_folder(given["weights"] or None)).views(scan, given["distance"])
    return MapTopic(node, given["base_frame"], used.range_max, config)


def main(args: list[str] | None = None) -> int:
    """Drive one robot; its last command is zero. Returns the exit status."""
    return run_executable("controller", Controlled, args)


if __name__ == "__main__":
    sys.exit(main())
