"""What wheel odometry tells: how far a robot has come, and where it would come to rest."""

from __future__ import annotations

import math

import numpy as np

from triform.geometry import wrap_angle
from triform.kernels import kernel
from triform.simulation.drive_kernels import advance_pose, drive_team
from triform.simulation.kinematics import drive_limits, integrate
from triform.simulation.profiles import Drive
from triform.types import BoolArray, FloatArray

#: Parts of the time that wheels need to slow down; the poses at its end are accurate to second order in their length.
_RAMP_STEPS = 16


def relative_poses(poses: FloatArray, origin: FloatArray, active: BoolArray) -> FloatArray:
    """Poses in the body frames that robots had before.

    Args:
        poses: Poses now, in the world frame [m, m, rad], shape (..., 3).
        origin: Poses before, shape (..., 3).
        active: Robots that exist, shape (...); the others get zeros.

    Returns:
        Poses (x, y, heading) in the frames of ``origin``, headings in [-pi, pi), shape (..., 3).
    """
    d_x, d_y, turned = np.moveaxis(poses - origin, -1, 0)
    cos, sin = np.cos(origin[..., 2]), np.sin(origin[..., 2])
    relative = np.stack([cos * d_x + sin * d_y, cos * d_y - sin * d_x, wrap_angle(turned)], axis=-1)
    return np.where(active[..., None], relative, 0.0)


def resting_poses(poses: FloatArray, velocities: FloatArray, drive: Drive) -> FloatArray:
    """Poses in which robots come to rest if they are told to stop now.

    A controller that steers to a place from where the robot is now drives past it, because wheels do not stop at once,
    and robots that do so with each other swing about their places. One that steers from here does not.

    Args:
        poses: Poses in the world frame [m, m, rad], shape (..., 3).
        velocities: Body twists [m/s, m/s, rad/s], shape (..., 3).
        drive: What the base can do.

    Returns:
        Shape (..., 3); where nothing limits the acceleration and nothing lags, ``poses``.
    """
    if drive.is_differential:
        resting, twists = np.array(poses), np.array(velocities)
        _roll_out_into(resting.reshape(-1, 3), twists.reshape(-1, 3), drive_limits(drive)[None])
        return resting
    speed = np.linalg.norm(velocities[..., :2], axis=-1, keepdims=True)
    time = braking_time(speed, drive.max_acceleration, drive.lag)
    turning = braking_time(np.abs(velocities[..., 2:]), drive.max_turn_acceleration, drive.lag)
    return integrate(poses, np.concatenate([velocities[..., :2] * time, velocities[..., 2:] * turning], axis=-1), 1.0)


@kernel
def _roll_out_into(poses: FloatArray, velocities: FloatArray, limits: FloatArray) -> None:
    """Move N differential robots along the arcs on which their wheels come to rest.

    While a limit of acceleration holds, speed and turn rate fall at rates of their own, and the arc changes; afterwards
    both fall in proportion, and the rest is one arc. How long that takes is each robot's own.

    Args:
        poses: Poses in the world frame, shape (N, 3) [m, m, rad]; overwritten.
        velocities: Body twists, shape (N, 3) [m/s, m/s, rad/s]; overwritten.
        limits: Largest acceleration [m/s^2], largest turn acceleration [rad/s^2], lag [s], shape (1, 3).
    """
    lag = limits[0, 2]
    rest = np.zeros((1, 3))
    exists, alone = np.ones(1, np.bool_), np.array([0, 1])
    for i in range(poses.shape[0]):
        pose, twist = poses[i : i + 1], velocities[i : i + 1]
        ramp = max(math.hypot(twist[0, 0], twist[0, 1]) / limits[0, 0], abs(twist[0, 2]) / limits[0, 1]) - lag
        if ramp > 0.0:
            for _ in range(_RAMP_STEPS):
                drive_team(pose, twist, rest, exists, alone, limits, ramp / _RAMP_STEPS)
        poses[i, 0], poses[i, 1], poses[i, 2] = advance_pose(
            pose[0, 0], pose[0, 1], pose[0, 2], lag * twist[0, 0], lag * twist[0, 1], lag * twist[0, 2], 1.0
        )


def braking_time(speed: FloatArray, acceleration: float, lag: float) -> FloatArray:
    """For how long a speed would have to be kept to come as far as it takes to brake from it [s].

    Args:
        speed: Speeds, not negative, of any shape [m/s or rad/s].
        acceleration: Largest one [m/s^2 or rad/s^2].
        lag: Time constant of the base [s]: slow robots slow down exponentially, fast ones as fast as they can.
    """
    if math.isinf(acceleration):
        return np.full_like(speed, lag)
    slow = np.minimum(speed, acceleration * lag)
    way = (speed**2 - slow**2) / (2 * acceleration) + slow * lag
    return np.asarray(np.divide(way, speed, out=np.zeros_like(speed), where=speed > 0))


def halfway(start: FloatArray, end: FloatArray, active: BoolArray) -> FloatArray:
    """Poses midway between two, shape (..., 3) like both; headings along the shorter turn, arguments as above."""
    half = relative_poses(end, start, active)[..., 2:] / 2
    return np.concatenate([(end + start)[..., :2] / 2, start[..., 2:] + half], axis=-1)
