"""The plaintext protocol of the RoboMaster EP: ports, limits, signs, and the text of commands and pushes."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from triform.robots.robomaster.watchdog import STOP
from triform.types import FloatArray, TriformError

#: Where the robot takes commands (TCP).
CONTROL_PORT = 40923
#: Where the robot sends its telemetry to, on the computer that commands it (UDP).
PUSH_PORT = 40924
#: Telemetry can be had at these rates [Hz].
PUSH_RATES = (1, 5, 10, 20, 30, 50)

#: Fastest command that the robot takes along x and y [m/s], and fastest turn [rad/s].
MAX_SPEED = 3.5
MAX_TURN_RATE = math.radians(600)
#: Fastest wheel [rpm].
MAX_WHEEL_RATE = 1000

#: The robot's x axis points forward, its y axis to the right, and it turns clockwise. This turns a body twist or a pose
#: of REP 103 into the robot's, and back. ``docs/robomaster.md`` tells the sources and how to check your robot.
ROBOT_SIGNS = np.array([1.0, -1.0, -1.0])

#: Signs of (x, y, turn) of REP 103 in the speeds of w1 to w4: front right, front left, rear right, rear left.
_WHEELS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0]])
_WHEEL_RADIUS = 0.05
_HALF_AXES = 0.2

#: Numbers that follow the name of a pushed attribute.
_PUSHED = {"position": 2, "attitude": 3}


class RoboMasterError(TriformError):
    """A RoboMaster cannot be reached, does not answer, or refuses a command."""


def speed_command(command: FloatArray) -> str:
    """Text of a body twist of REP 103, shape (3,) [m/s, m/s, rad/s]; to 1 mm/s and 0.01 deg/s, zero as a stop."""
    x, y, z = ROBOT_SIGNS * command
    # Adding zero turns a negative zero into zero.
    text = [f"{round(x, 3) + 0:.3f}", f"{round(y, 3) + 0:.3f}", f"{round(math.degrees(z), 2) + 0:.2f}"]
    return "chassis speed x {} y {} z {};".format(*text) if any(float(number) for number in text) else STOP


def twist_of_speeds(x: float, y: float, z: float) -> FloatArray:
    """Body twist of REP 103, shape (3,), of the robot's speeds [m/s, m/s, deg/s]."""
    return np.asarray(ROBOT_SIGNS * [x, y, math.radians(z)])


def twist_of_wheels(rates: FloatArray) -> FloatArray:
    """Body twist of REP 103, shape (3,), of the wheels w1 to w4 [rpm], shape (4,)."""
    speeds = np.asarray(rates) * (2 * math.pi / 60 * _WHEEL_RADIUS)
    return np.asarray(speeds @ _WHEELS / 4 / [1.0, 1.0, _HALF_AXES])


def speeds_of_twist(twist: FloatArray) -> tuple[list[float], list[int]]:
    """The robot's speeds (x, y, z) [m/s, m/s, deg/s] and those of its wheels w1 to w4 [rpm], of a twist of REP 103."""
    x, y, z = ROBOT_SIGNS * twist
    rates = _WHEELS @ (twist * [1.0, 1.0, _HALF_AXES]) / (2 * math.pi / 60 * _WHEEL_RADIUS)
    # Adding zero turns a negative zero into zero.
    return [float(x) + 0.0, float(y) + 0.0, math.degrees(z) + 0.0], [round(rate) for rate in rates]


def chassis_state(pose: FloatArray, still: bool) -> dict[str, list[str]]:
    """What the robot says about its chassis: ``position``, ``attitude`` and ``status``, each as words.

    Args:
        pose: Pose of REP 103, shape (3,) [m, m, rad].
        still: Whether the robot stands, the only state that is told of one on an even floor.
    """
    x, y, yaw = ROBOT_SIGNS * pose
    numbers = {"position": (x, y), "attitude": (0.0, 0.0, math.degrees(yaw))}
    words = {name: [f"{number + 0.0:.3f}" for number in each] for name, each in numbers.items()}
    return {**words, "status": [str(int(still)), *["0"] * 10]}


def read_pushed(text: str) -> Iterator[tuple[str, FloatArray]]:
    """Give what a datagram tells, in REP 103: ``position``, shape (2,) [m], and ``attitude``, the heading (1,) [rad].

    One datagram may hold several attributes; a part that does not name the chassis belongs to what was named before.
    Anything else, and anything damaged, is passed over.
    """
    subject = ""
    for part in text.split(";"):
        words = part.split()
        if words[1:2] == ["push"]:
            subject, words = words[0], words[2:]
        if subject != "chassis" or not words or len(words) - 1 != _PUSHED.get(words[0]):
            continue
        try:
            numbers = np.array([float(word) for word in words[1:]])
        except ValueError:
            continue
        if not np.isfinite(numbers).all():
            continue
        if words[0] == "position":
            yield words[0], ROBOT_SIGNS[:2] * numbers
        else:
            yield words[0], ROBOT_SIGNS[2:] * np.radians(numbers[2:])
