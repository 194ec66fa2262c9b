"""Changes between the world frame and the body frame of a robot."""

from __future__ import annotations

import numpy as np

from triform.types import FloatArray


def body_to_world(vectors: FloatArray, heading: FloatArray | float) -> FloatArray:
    """Rotate planar vectors from the body frame into the world frame (the rotation of Eq. 1).

    Args:
        vectors: Vectors in the body frame, shape (..., 2).
        heading: Heading of each robot [rad], broadcast over the leading axes.

    Returns:
        The vectors in the world frame, shape (..., 2).
    """
    cos, sin = np.cos(heading), np.sin(heading)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def wrap_angle(angle: FloatArray | float) -> FloatArray:
    """Wrap angles [rad] into [-pi, pi)."""
    wrapped = np.asarray((np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi, dtype=np.float64)
    # Just below -pi the remainder rounds up to a whole turn.
    return np.where(wrapped >= np.pi, -np.pi, wrapped)
