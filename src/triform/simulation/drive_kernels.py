"""Compiled motion of robots: exact for the drive's limits and lag, whatever the step.

All functions allocate nothing and can be called from other kernels.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from triform.kernels import kernel

_TWO_PI = 2 * math.pi


@kernel
def wrap(angle: float) -> float:
    """Return the same angle in [-pi, pi) [rad]."""
    turned = angle - _TWO_PI * math.floor((angle + math.pi) / _TWO_PI)
    # Rounding may leave an angle just below -pi at +pi.
    return -math.pi if turned >= math.pi else turned


@kernel
def advance_pose(
    x: float, y: float, heading: float, ux: float, uy: float, omega: float, duration: float
) -> tuple[float, float, float]:
    """Move a pose by a constant body twist: the exponential map of SE(2).

    The robot runs along an arc whose chord has the direction of the half-way heading and the length of the arc
    times ``sin(a) / a`` with ``a = omega * duration / 2``.
    """
    half = 0.5 * omega * duration
    chord = duration if half == 0.0 else duration * math.sin(half) / half
    cos = math.cos(heading + half)
    sin = math.sin(heading + half)
    return x + chord * (cos * ux - sin * uy), y + chord * (sin * ux + cos * uy), wrap(heading + 2 * half)


@kernel
def limit_twist(
    ux: float, uy: float, omega: float, max_speed: float, max_axis_speed: float, max_turn_rate: float
) -> tuple[float, float, float]:
    """Shorten the translation to ``max_speed``, then clip each axis and the turn rate."""
    speed = math.hypot(ux, uy)
    if speed > max_speed:
        ux *= max_speed / speed
        uy *= max_speed / speed
    return (
        min(max(ux, -max_axis_speed), max_axis_speed),
        min(max(uy, -max_axis_speed), max_axis_speed),
        min(max(omega, -max_turn_rate), max_turn_rate),
    )


@kernel
def approach(gap: float, limit: float, lag: float, duration: float) -> tuple[float, float]:
    """Shares of a velocity error ``gap`` that remain at the end and on the mean of ``duration``.

    The velocity follows ``v' = (target - v) / lag`` with ``|v'| <= limit``. Its error keeps its direction: it
    shrinks at the rate ``limit`` while it is larger than ``limit * lag``, then exponentially; without lag it
    shrinks at the rate ``limit`` to zero. Both phases are integrated exactly.

    Args:
        gap: Norm of the error at the beginning [m/s or rad/s].
        limit: Largest acceleration, ``inf`` for none [m/s^2 or rad/s^2].
        lag: Time constant, 0 for none [s].
        duration: Time to advance [s].

    Returns:
        The error at the end and its mean over ``duration``, both divided by ``gap``.
    """
    # Of a gap next to nothing, the product is zero, which must not divide.
    if gap * duration == 0.0 or (limit == math.inf and lag == 0.0):
        return 0.0, 0.0
    left = gap
    area = 0.0
    rest = duration
    if limit != math.inf and gap > limit * lag:
        ramp = min((gap - limit * lag) / limit, duration)
        left = gap - limit * ramp
        area = 0.5 * (gap + left) * ramp
        rest = duration - ramp
    if rest > 0.0:
        if lag == 0.0:
            left = 0.0
        else:
            decay = -math.expm1(-rest / lag)
            area += left * lag * decay
            left -= left * decay
    return left / gap, area / (gap * duration)


@kernel
def drive_team(
    poses: Any, velocities: Any, targets: Any, active: Any, kinds: Any, limits: Any, duration: float
) -> None:
    """Advance the ``poses`` and body ``velocities`` of one team in place.

    Args:
        poses: Poses in the world frame, shape (N, 3) [m, m, rad].
        velocities: Actual body twists, shape (N, 3) [m/s, m/s, rad/s].
        targets: Limited body twists that the bases are steering to, shape (N, 3) [m/s, m/s, rad/s].
        active: Robots that exist, shape (N,); the others are left alone.
        kinds: Kind k has the robots from ``kinds[k]`` up to ``kinds[k + 1]``, shape (K + 1,).
        limits: Of each kind, the largest acceleration [m/s^2], largest turn acceleration [rad/s^2], lag [s], shape
            (K, 3).
        duration: Time to advance [s].
    """
    for kind in range(limits.shape[0]):
        limit, turn_limit, lag = limits[kind, 0], limits[kind, 1], limits[kind, 2]
        # Unsigned, because signed indices are checked for being counted from the end.
        for i in range(np.uint64(kinds[kind]), np.uint64(kinds[kind + 1])):
            if not active[i]:
                continue
            gap_x = velocities[i, 0] - targets[i, 0]
            gap_y = velocities[i, 1] - targets[i, 1]
            gap_turn = velocities[i, 2] - targets[i, 2]
            left, mean = approach(math.sqrt(gap_x * gap_x + gap_y * gap_y), limit, lag, duration)
            left_turn, mean_turn = approach(abs(gap_turn), turn_limit, lag, duration)
            u_x, u_y = targets[i, 0] + mean * gap_x, targets[i, 1] + mean * gap_y
            omega = targets[i, 2] + mean_turn * gap_turn
            poses[i, 0], poses[i, 1], poses[i, 2] = advance_pose(
                poses[i, 0], poses[i, 1], poses[i, 2], u_x, u_y, omega, duration
            )
            velocities[i, 0] = targets[i, 0] + left * gap_x
            velocities[i, 1] = targets[i, 1] + left * gap_y
            velocities[i, 2] = targets[i, 2] + left_turn * gap_turn
