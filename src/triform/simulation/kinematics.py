"""Kinematics of a base (Eq. 1-2): limits, lag and motion.

The base steers its body twist ``v`` to the limited command ``u`` by ``v' = (u - v) / lag`` with ``|v'|``
bounded, and moves by ``p' = R(heading) v``. Commands, limits and lag act in the body frame.

A differential base differs in the limited command alone: it has no speed to the side, and so never gets one.
"""

from __future__ import annotations

import numpy as np

from triform.geometry.unicycle import Wheels, roll
from triform.kernels import kernel
from triform.simulation.drive_kernels import advance_pose, drive_team, limit_twist
from triform.simulation.profiles import Drive
from triform.types import FloatArray, as_array, converted, require

#: Radius of a RoboMaster EP's wheels [m].
WHEEL_RADIUS = 0.05


@kernel
def _integrate_into(poses: FloatArray, twists: FloatArray, duration: float) -> None:
    for i in range(poses.shape[0]):
        poses[i, 0], poses[i, 1], poses[i, 2] = advance_pose(
            poses[i, 0], poses[i, 1], poses[i, 2], twists[i, 0], twists[i, 1], twists[i, 2], duration
        )


def integrate(poses: FloatArray, twists: FloatArray, duration: float) -> FloatArray:
    """Move poses by constant body twists, exactly (the exponential map of SE(2)).

    Args:
        poses: Poses (x, y, heading) in the world frame, shape (..., 3) [m, m, rad].
        twists: Body twists, same shape [m/s, m/s, rad/s].
        duration: Time [s].

    Returns:
        Poses after ``duration``, headings in [-pi, pi).

    Raises:
        ConfigurationError: If the shapes differ, or something is no number.
    """
    moved, held = np.array(as_array("poses", poses)), as_array("twists", twists)
    _check_pair("poses", moved, "twists", held)
    _integrate_into(moved.reshape(-1, 3), held.reshape(-1, 3), float(converted("duration", duration, float)))
    return moved


@kernel
def _limit_into(twists: FloatArray, max_speed: float, max_axis_speed: float, max_turn_rate: float) -> None:
    for i in range(twists.shape[0]):
        twists[i, 0], twists[i, 1], twists[i, 2] = limit_twist(
            twists[i, 0], twists[i, 1], twists[i, 2], max_speed, max_axis_speed, max_turn_rate
        )


@kernel
def _roll_into(twists: FloatArray, wheels: Wheels) -> None:
    for i in range(twists.shape[0]):
        along, turn = roll(twists[i, 0], twists[i, 1], twists[i, 2], wheels)
        twists[i, 0], twists[i, 1], twists[i, 2] = along, 0.0, turn


def limit_twists(twists: FloatArray, drive: Drive) -> FloatArray:
    """Return ``twists``, shape (..., 3), as the base drives them.

    Holonomic: the translation is shortened to ``max_speed`` in its own direction; then x and y are each clipped to
    ``max_axis_speed`` and the turn rate to ``max_turn_rate``. Differential: ``triform.geometry.unicycle.roll``.

    Raises:
        ConfigurationError: If the twists are malformed.
    """
    limited = np.array(as_array("twists", twists))
    require(limited.shape[-1:] == (3,), f"twists of shape {limited.shape} given; (..., 3) is needed")
    wheels = drive.wheels
    if wheels is not None:
        _roll_into(limited.reshape(-1, 3), wheels)
        return limited
    _limit_into(limited.reshape(-1, 3), float(drive.max_speed), float(drive.max_axis_speed), float(drive.max_turn_rate))
    return limited


def steer(
    poses: FloatArray, velocities: FloatArray, commands: FloatArray, drive: Drive, duration: float
) -> tuple[FloatArray, FloatArray]:
    """Advance robots that were given ``commands`` by one integration step.

    Velocities are exact for any step; the pose moves by the exact mean body twist, which under changing
    velocity and turn rate is accurate to second order in the step.

    Args:
        poses: Poses in the world frame, shape (..., 3) [m, m, rad].
        velocities: Actual body twists, same shape [m/s, m/s, rad/s].
        commands: Commanded body twists, same shape [m/s, m/s, rad/s].
        drive: Limits and lag.
        duration: Time to advance, positive [s].

    Returns:
        Poses and velocities after ``duration``.

    Raises:
        ConfigurationError: If the shapes differ, or something is no number.
    """
    moved, reached = np.array(as_array("poses", poses)), np.array(as_array("velocities", velocities))
    targets = limit_twists(commands, drive)
    _check_pair("poses", moved, "velocities", reached)
    _check_pair("poses", moved, "commands", targets)
    teams = [each.reshape(-1, 3) for each in (moved, reached, targets)]
    drive_team(
        *teams,
        np.ones(len(teams[0]), dtype=np.bool_),
        np.array([0, len(teams[0])]),
        drive_limits(drive)[None],
        float(converted("duration", duration, float)),
    )
    return moved, reached


def drive_limits(drive: Drive) -> FloatArray:
    """Return the limits of one kind in the order that ``drive_team`` takes: acceleration, turn acceleration, lag."""
    return np.array([drive.max_acceleration, drive.max_turn_acceleration, drive.lag], dtype=np.float64)


def _check_pair(name: str, values: FloatArray, other_name: str, others: FloatArray) -> None:
    require(
        values.shape == others.shape and values.ndim >= 1 and values.shape[-1] == 3,
        f"{name} of shape {values.shape} and {other_name} of shape {others.shape} given; "
        "both must have the same shape (..., 3)",
    )
