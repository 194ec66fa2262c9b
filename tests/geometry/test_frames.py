from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.geometry import body_to_world, wrap_angle

angles = st.floats(-20, 20)


@settings(deadline=None)
@given(angles, st.floats(-5, 5), st.floats(-5, 5))
def test_body_and_world_are_inverse_and_keep_length(heading: float, x: float, y: float) -> None:
    vector = np.array([x, y])
    world = body_to_world(vector, heading)
    np.testing.assert_allclose(body_to_world(world, -heading), vector, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(world), np.linalg.norm(vector), atol=1e-12)


def test_forward_points_along_the_heading() -> None:
    heading = np.array([0.0, np.pi / 2, np.pi])
    forward = body_to_world(np.array([[1.0, 0.0]] * 3), heading)
    np.testing.assert_allclose(forward, [[1, 0], [0, 1], [-1, 0]], atol=1e-12)


@settings(deadline=None)
@given(angles)
def test_wrapped_angles_are_the_same_direction(angle: float) -> None:
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(angle), np.sin(angle)], atol=1e-9)
