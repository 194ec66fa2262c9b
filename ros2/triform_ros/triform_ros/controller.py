"""The executable ``controller``: one robot, from its scans to its wheels, through Algorithm 2's loop."""

from __future__ import annotations

import math
import sys
import threading
import time
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import rclpy.parameter
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from std_srvs.srv import SetBool

from triform.control import SafetyFilter, drive
from triform.robots.real import RealRobot, Step
from triform.simulation import Mounting, read_sectors
from triform.types import Controller, FloatArray, TriformError, View
from triform_ros.diagnostics import Diagnostics
from triform_ros.executable import run_executable
from triform_ros.markers import Intended, MarkerTopic
from triform_ros.parameters import declare, given_names
from triform_ros.robot import MapTopic, ScanTopic, TwistTopic
from triform_ros.settings import MOUNTING, Settings, parameters
from triform_ros.static_frames import StaticFrames, has_transforms


class _Changed(Exception):  # noqa: N818
    """A parameter has changed, and the robot goes on with others."""


@dataclass(frozen=True)
class Plan:
    """What drives a robot until a parameter changes.

    Attributes:
        settings: What the parameters say.
        intended: The controller.
        controller: The same behind its safety filter, if the parameters want one.
    """

    settings: Settings
    intended: Intended
    controller: Controller[View]

    @classmethod
    def of(cls, settings: Settings, before: Plan | None = None) -> Plan:
        """Make what the settings want, with the controller of before if nothing that it knows has changed.

        Raises:
            TriformError: The controller cannot be made.
        """
        known = ("distance", "min_intensity")
        if before is not None and all(before.settings.given[name] == settings.given[name] for name in known):
            intended = before.intended
        else:
            intended = Intended(settings.make_controller())
        guard = settings.given["guard"]
        return cls(settings, intended, SafetyFilter(intended, settings.filter) if guard else intended)


class Controlled:
    """One robot with its parameters and topics."""

    def __init__(self, node: Node) -> None:
        """Declare, check and connect everything.

        Raises:
            TriformError: A parameter cannot be used.
        """
        self.node = node
        names = given_names(node)
        profile = node.get_parameter("profile").value if "profile" in names else ""
        given = declare(node, parameters(profile))
        settings = Settings(given)
        self._plan, self._planning = Plan.of(settings), threading.Lock()
        # Robots that share their seed, as those of one parameter file do, differ in their names.
        self._seed = (given["seed"] << 32) + zlib.crc32(node.get_fully_qualified_name().encode())
        self._mounting_is_given = bool(names & MOUNTING)
        robot, frame = settings.robot, given["base_frame"]
        self._scans = ScanTopic(node, given["scan_frame"])
        self._wheels = TwistTopic(
            node, frame, given["stamped"], robot.odometry, settings.command_limits, robot.control_period
        )
        self._wheels.enabled = given["enabled"]
        self._maps = MapTopic(node, frame)
        self._markers = MarkerTopic(node, frame)
        self._diagnostics = Diagnostics(node, robot.name, self._scans, self._wheels)
        node.add_on_set_parameters_callback(self._set)
        node.create_service(SetBool, "~/enable", self._enable)

    def run(self, check: Callable[[], None]) -> None:
        """Drive until an exception ends it, as that of ``check`` between two commands.

        Raises:
            TriformError: ROS has been shut down, scans do not fit the controller, or the LiDAR is tilted.
        """
        self._mount(check)
        robot, log = self._plan.settings.robot, self.node.get_logger()
        kind = f"a {robot.drive.kind} base" + (f" as in the profile {robot.name!r}" if robot.name else "")
        log.info(
            f"driving {kind} at {1 / robot.control_period:g} Hz; the safety filter's reaction is "
            f"{self._plan.settings.filter.reaction:.2f} s, its pace {self._plan.settings.filter.pace:.2g}"
        )
        if not self._wheels.enabled:
            log.info("the robot is disabled: its commands are zero until ~/enable or the parameter enabled says true")
        while True:
            with suppress(_Changed):
                self._drive(self._plan, check)

    def stop(self) -> None:
        """Publish the last command, zero, and say what was received."""
        self._wheels.stop()
        scans = self._scans
        self.node.get_logger().info(
            f"received {scans.received} scans, refused {scans.refused}, lost {scans.lost}, "
            f"{self._diagnostics.late} late commands"
        )

    def _drive(self, plan: Plan, check: Callable[[], None]) -> None:
        """Drive until a parameter changes.

        Raises:
            _Changed: One has.
            TriformError: As ``run``.
        """
        settings, given = plan.settings, plan.settings.given
        robot = settings.robot
        if given["publish_map"]:
            self._maps.show(*settings.policy_map)

        def note(step: Step) -> None:
            self._diagnostics.note(step, real.standing)
            if given["publish_map"]:
                self._maps.publish(settings.seen(step.view))
            self._markers.publish(step, plan.intended.last, settings)

        def checked(view: View, commands: FloatArray) -> None:  # noqa: ARG001
            check()
            if self._plan is not plan:
                raise _Changed

        self._scans.place(robot)
        self._wheels.limit(settings.command_limits)
        real = RealRobot(
            self._scans,
            self._wheels,
            robot.control_period,
            self._seed,
            robot.drive,
            placement=settings.placement,
            pace=settings.filter.pace,
            odometry=robot.odometry,
            scan_timeout=given["scan_timeout"],
            on_sent=note,
            warn=self.node.get_logger().warning,
        )
        drive(real, plan.controller, math.inf, checked)

    def _mount(self, check: Callable[[], None]) -> None:
        """Find out how the LiDAR is mounted, while the robot stands.

        Raises:
            TriformError: ROS has been shut down, or the LiDAR is tilted.
        """
        settings, log = self._plan.settings, self.node.get_logger()
        source = "from the parameters"
        found = None
        if not self._mounting_is_given:
            source = (
                f"as in the profile {settings.robot.name!r}" if settings.robot.name else "as the parameters have it"
            )
            if has_transforms():
                found = self._look_up(check)
            else:
                log.info("there is no package tf2_msgs: /tf_static cannot say how the LiDAR is mounted")
        if found is not None:
            source = "by /tf_static"
            with self._planning:
                self._plan = Plan.of(replace(self._plan.settings, found=found), self._plan)
        mounting = self._plan.settings.robot.mounting
        log.info(
            f"the LiDAR is {mounting.x:.3f} m ahead and {mounting.y:.3f} m left of the robot's centre, turned by "
            f"{math.degrees(mounting.yaw):.0f} degrees, {'upright' if mounting.upright else 'upside down'}, {source}"
        )

    def _look_up(self, check: Callable[[], None]) -> Mounting | None:
        """Wait for a scan and the transforms to its frame; ``None`` if they do not come in time."""
        given = self._plan.settings.given
        base, timeout, sectors = given["base_frame"], given["tf_timeout"], read_sectors(given["blind_sectors"])
        frames, deadline = StaticFrames(self.node), math.inf
        mounting = None
        while mounting is None and time.monotonic() < deadline:
            check()
            self._wheels.drive(np.zeros(3))
            time.sleep(self._plan.settings.robot.control_period)
            frame = self._scans.seen_frame
            if frame is not None:
                self._diagnostics.waiting = f"waiting for the transform from {base} to {frame} on /tf_static"
                deadline = min(deadline, time.monotonic() + timeout)
                mounting = frames.mounting(base, frame, sectors)
        frames.close()
        if mounting is None:
            self.node.get_logger().warning(
                f"/tf_static has not said within {timeout:g} s where {self._scans.seen_frame!r} is in {base!r}"
            )
        return mounting

    def _set(self, changed: Sequence[rclpy.parameter.Parameter]) -> SetParametersResult:
        """Take new values of parameters, or refuse them in a sentence; called by the thread that listens."""
        values = {each.name: each.value for each in changed}
        with self._planning:
            before = self._plan.settings
            try:
                if set(values) - {"enabled"}:
                    self._plan = Plan.of(replace(before, given={**before.given, **values}), self._plan)
            except TriformError as error:
                return SetParametersResult(successful=False, reason=str(error))
        self._wheels.enabled = values.get("enabled", self._wheels.enabled)
        return SetParametersResult(successful=True)

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Let the robot drive, or make it stand."""
        wanted = rclpy.parameter.Parameter("enabled", value=request.data)
        result = self.node.set_parameters([wanted])[0]
        response.success, response.message = result.successful, result.reason or f"enabled: {request.data}"
        return response


def main(args: list[str] | None = None) -> int:
    """Drive one robot; its last command is zero. Returns the exit status."""
    return run_executable("controller", Controlled, args)


if __name__ == "__main__":
    sys.exit(main())
