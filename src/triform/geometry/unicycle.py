"""From the body twist of a holonomic controller to what two driven wheels do: a speed along the axis and a turn rate.

A wanted velocity makes the angle e with the robot's axis, folded into [-90 deg, 90 deg] if the robot may reverse. The
robot drives ``v = |u| cos^16(e)`` forwards or backwards and turns with ``omega = k e``, besides the turn rate that the
command itself asks for: it turns first, and drives when it is nearly there, half as fast at 17 degrees. A command along
the axis is driven as it is, so what has been converted once stays as it is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from triform.kernels import kernel

#: Turn rate for each angle between the wanted velocity and the axis [1/s].
TURN_GAIN = 4.0
#: Wanted speed below which a robot turns slower in proportion, so that one at rest does not turn on the spot [m/s].
_FULL_TURN_SPEED = 0.02


class Wheels(NamedTuple):
    """What two driven wheels allow, as kernels take it.

    Attributes:
        max_speed: Largest speed along the axis [m/s].
        max_turn_rate: Largest turn rate [rad/s].
        half_track: Half the distance between the wheels [m].
        max_wheel_speed: Largest speed of a wheel over the ground [m/s].
        reverses: Whether the robot may drive backwards.
    """

    max_speed: float
    max_turn_rate: float
    half_track: float
    max_wheel_speed: float
    reverses: bool


@kernel
def roll(u_x: float, u_y: float, omega: float, wheels: Wheels) -> tuple[float, float]:
    """Return the speed along the axis [m/s] and the turn rate [rad/s] with which wheels follow a body twist.

    Args:
        u_x: Wanted velocity, forward [m/s].
        u_y: Wanted velocity, to the left [m/s].
        omega: Wanted turn rate [rad/s].
        wheels: Limits. Speed and turn rate are clipped to theirs; what is too fast for a wheel is slowed down as a
            whole, so that the robot keeps its arc.
    """
    speed = math.hypot(u_x, u_y)
    error, sign = 0.0, 1.0
    if u_y == 0.0 and (u_x >= 0.0 or wheels.reverses):
        sign = -1.0 if u_x < 0.0 else 1.0
    else:
        error = math.atan2(u_y, u_x)
        if wheels.reverses and abs(error) > 0.5 * math.pi:
            error -= math.copysign(math.pi, error)
            sign = -1.0
    share = max(math.cos(error), 0.0)
    for _ in range(4):
        share *= share
    along = sign * min(speed, wheels.max_speed) * share
    turn = omega + TURN_GAIN * error * min(speed / _FULL_TURN_SPEED, 1.0)
    turn = min(max(turn, -wheels.max_turn_rate), wheels.max_turn_rate)
    fastest = abs(along) + wheels.half_track * abs(turn)
    if fastest > wheels.max_wheel_speed:
        slower = wheels.max_wheel_speed / fastest
        along, turn = along * slower, turn * slower
    return along, turn
