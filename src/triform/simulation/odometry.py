"""What wheel odometry tells: how far a robot has come."""

from __future__ import annotations

import numpy as np

from triform.types import BoolArray, FloatArray


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
    turned = (turned + np.pi) % (2 * np.pi) - np.pi
    relative = np.stack([cos * d_x + sin * d_y, cos * d_y - sin * d_x, turned], axis=-1)
    return np.where(active[..., None], relative, 0.0)


def halfway(start: FloatArray, end: FloatArray, active: BoolArray) -> FloatArray:
    """Poses midway between two, shape (..., 3) like both; headings along the shorter turn, arguments as above."""
    half = relative_poses(end, start, active)[..., 2:] / 2
    return np.concatenate([(end + start)[..., :2] / 2, start[..., 2:] + half], axis=-1)
