"""What the robot sees and wants, for RViz, on the topic ``markers``.

Velocities are drawn as the way of the next second.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Vector3
from rclpy.node import Node
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from triform.control import SafetySettings, limit_by_scans
from triform.control.detection import detect_robots
from triform.robots.real import Step
from triform.simulation import integrate
from triform.types import Controller, FloatArray, Scan, View
from triform_ros.settings import Settings

#: Directions in which the filter is asked what it allows.
_DIRECTIONS = 36
#: Points of the way that a command leads.
_PARTS = 11
_HEIGHT = 0.3


class Intended:
    """A controller that remembers its last command: what the robot wants before the safety filter.

    Attributes:
        last: That command, shape (3,) [m/s, m/s, rad/s].
    """

    def __init__(self, controller: Controller[View]) -> None:
        """Listen to a controller of one robot."""
        self._controller = controller
        self.last: FloatArray = np.zeros(3)

    @property
    def privileged(self) -> bool:
        """As the controller."""
        return self._controller.privileged

    @property
    def description(self) -> dict[str, Any]:
        """As the controller's."""
        return self._controller.description

    def command(self, view: View) -> FloatArray:
        """Return the controller's command, shape (1, 1, 3)."""
        command = self._controller.command(view)
        self.last = command[0, 0]
        return command


def neighbours(view: View, footprint: tuple[float, float] | float) -> FloatArray:
    """Return the centres of the robots in a robot's scan, from where it comes to rest, shape (M, 2) [m]."""
    centres = detect_robots(view.scans, footprint)[0][0, 0]
    if view.odometry is None:
        return centres
    x, y, heading = view.odometry[0, 0]
    cos, sin = np.cos(heading), np.sin(heading)
    return np.asarray((centres - [x, y]) @ np.array([[cos, -sin], [sin, cos]]))


def allowed_velocities(view: View, settings: SafetySettings) -> FloatArray:
    """Return the border of the velocities that the safety filter allows a robot, shape (K, 2) [m/s].

    Each is the nearest allowed one to the largest speed in some direction; a differential base is asked for straight
    ways alone.
    """
    speed, arcs = settings.max_speed, settings.arcs
    angles = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS if arcs is None else np.array([0.0, np.pi])
    wanted = np.stack([speed * np.cos(angles), speed * np.sin(angles), np.zeros(len(angles))], axis=-1)
    if arcs is not None:
        wanted[:, 1] = 0.0
    asked = (len(angles), 1)
    many = View(
        scans=Scan(np.broadcast_to(view.scans.ranges, (*asked, view.scans.config.rays)), view.scans.config),
        active=np.ones(asked, dtype=np.bool_),
        time=view.time,
        odometry=None if view.odometry is None else np.broadcast_to(view.odometry, (*asked, 3)),
    )
    return limit_by_scans(many, wanted[:, None], settings)[:, 0, :2]


def way_of(command: FloatArray) -> FloatArray:
    """Return the way of the next second under a body twist, shape (P, 2) [m]."""
    share = np.linspace(0.0, 1.0, _PARTS)
    return integrate(np.zeros((_PARTS, 3)), share[:, None] * command, 1.0)[:, :2]


class MarkerTopic:
    """Markers in the robot's frame."""

    def __init__(self, node: Node, frame: str) -> None:
        """Advertise."""
        self._node, self._frame = node, frame
        self._publisher = node.create_publisher(MarkerArray, "markers", 1)

    def publish(self, step: Step, intended: FloatArray, settings: Settings) -> None:
        """Publish the markers of a control period, if anybody listens.

        Args:
            step: What was seen and sent.
            intended: What the controller wanted, shape (3,) [m/s, m/s, rad/s].
            settings: What the parameters say.
        """
        if self._publisher.get_subscription_count() == 0:
            return
        footprint = settings.robot.footprint.size
        width = footprint if isinstance(footprint, float) else min(footprint)
        size, thin = Vector3(x=width, y=width, z=_HEIGHT), Vector3(x=0.02)
        centres = neighbours(settings.seen(step.view), footprint)
        shown = [
            self._marker("neighbours", Marker.SPHERE_LIST, centres, (0.1, 0.5, 1.0), size),
            self._marker("intended", Marker.LINE_STRIP, way_of(intended * [1, 1, 0]), (1.0, 0.7, 0.0), thin),
            self._marker("command", Marker.LINE_STRIP, way_of(step.command), (0.0, 0.9, 0.2), Vector3(x=0.04)),
        ]
        if settings.given["guard"]:
            border = allowed_velocities(step.view, settings.filter)
            shown.append(self._marker("allowed", Marker.LINE_STRIP, [*border, border[0]], (1.0, 0.2, 0.2), thin))
        self._publisher.publish(MarkerArray(markers=shown))

    def _marker(
        self, name: str, kind: int, points: Sequence[FloatArray] | FloatArray, colour: Sequence[float], scale: Vector3
    ) -> Marker:
        """Return one marker; without points it takes an earlier one away."""
        marker = Marker(ns=name, type=kind, action=Marker.ADD if len(points) else Marker.DELETE, scale=scale)
        marker.header.stamp, marker.header.frame_id = self._node.get_clock().now().to_msg(), self._frame
        marker.pose.orientation.w = 1.0
        marker.color = ColorRGBA(r=colour[0], g=colour[1], b=colour[2], a=0.8)
        marker.points = [Point(x=float(x), y=float(y), z=_HEIGHT / 2) for x, y in points]
        return marker
