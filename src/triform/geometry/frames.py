"""Changes between the world frame and the body frame of a robot."""

from __future__ import annotations

import numpy as np

from triform.types import FloatArray, as_array, require


def body_to_world(vectors: FloatArray, heading: FloatArray | float) -> FloatArray:
    """Rotate planar vectors from the body frame into the world frame (the rotation of Eq. 1).

    Args:
        vectors: Vectors in the body frame, shape (..., 2).
        heading: Heading of each robot [rad], broadcast over the leading axes.

    Returns:
        The vectors in the world frame, shape (..., 2).

    Raises:
        ConfigurationError: If the vectors are malformed.
    """
    turned, angle = as_array("vectors", vectors), as_array("headings", heading)
    require(turned.shape[-1:] == (2,), f"vectors of shape {turned.shape} given; (..., 2) is needed")
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = turned[..., 0], turned[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def wrap_angle(angle: FloatArray | float) -> FloatArray:
    """Wrap angles [rad] into [-pi, pi)."""
    wrapped = (as_array("angles", angle) + np.pi) % (2 * np.pi) - np.pi
    # Just below -pi the remainder rounds up to a whole turn.
    return np.where(wrapped >= np.pi, -np.pi, wrapped)
