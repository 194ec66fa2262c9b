"""How the robot does, on the topic ``/diagnostics``, once a second."""

from __future__ import annotations

import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from triform.robots.real import Step
from triform_ros.robot import ScanTopic, TwistTopic

#: Time between two reports [s].
_PERIOD = 1.0
#: A robot that has not decided for so long hangs [s].
_HANGS = 2.0


class Diagnostics:
    """Reports whether the robot stands or drives, why, and what came of its scans and commands.

    Attributes:
        waiting: Why it does not decide yet; empty once it does.
        late: Commands that came after their control period had ended.
    """

    def __init__(self, node: Node, hardware: str, scans: ScanTopic, wheels: TwistTopic) -> None:
        """Advertise.

        Args:
            node: Where the topic is.
            hardware: Kind of robot.
            scans: Its LiDAR.
            wheels: Its base.
        """
        self._node, self._hardware, self._scans, self._wheels = node, hardware, scans, wheels
        self._step: Step | None = None
        self._standing = ""
        self.waiting = "no scan has come yet"
        self.late = 0
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 1)
        node.create_timer(_PERIOD, self._publish)

    def note(self, step: Step, standing: str) -> None:
        """Take a step, and why the robot stands if it does."""
        self._step, self._standing, self.waiting = step, standing, ""
        self.late += step.late

    def status(self, now: float) -> DiagnosticStatus:
        """Return how the robot does at a moment of the host's monotonic clock [s]."""
        step, scans, wheels = self._step, self._scans, self._wheels
        reason = self.waiting or self._standing
        level, state, message = DiagnosticStatus.OK, "driving", "driving"
        if not wheels.enabled:
            state, message = "disabled", "disabled: commands are zero until it is enabled"
        elif step is not None and not self.waiting and now - step.sent > _HANGS:
            level, state = DiagnosticStatus.ERROR, "hanging"
            message = f"no command for {now - step.sent:.1f} s"
        elif reason:
            level, state, message = DiagnosticStatus.WARN, "standing", f"standing: {reason}"
        elif not wheels.listeners:
            level, message = DiagnosticStatus.WARN, "driving, but nobody takes its commands"
        values = {
            "state": state,
            "reason": reason,
            "enabled": wheels.enabled,
            "scans received": scans.received,
            "scans refused": scans.refused,
            "scans lost": scans.lost,
            "age of the scan [s]": "" if step is None or step.turn is None else f"{now - step.turn.ended:.3f}",
            "late commands": self.late,
            "takers of commands": wheels.listeners,
        }
        pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        name = f"{self._node.get_fully_qualified_name()[1:]}: control"
        return DiagnosticStatus(level=level, name=name, message=message, hardware_id=self._hardware, values=pairs)

    def _publish(self) -> None:
        message = DiagnosticArray(status=[self.status(time.monotonic())])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
