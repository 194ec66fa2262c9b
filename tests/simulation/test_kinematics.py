"""Motion against numerical integration of its differential equations, and in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from triform.simulation import Drive, integrate, limit_twists, steer
from triform.types import ConfigurationError

Array = NDArray[np.float64]
SPEED = st.floats(-3, 3)


def _moved(pose: Array, velocity: Array) -> Array:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y, turn = velocity
    return np.array([cos * x - sin * y, sin * x + cos * y, turn])


def _angle_between(first: float, second: float) -> float:
    return float(abs((first - second + np.pi) % (2 * np.pi) - np.pi))


@settings(deadline=None, max_examples=40)
@given(
    pose=st.tuples(SPEED, SPEED, st.floats(-np.pi, 3.14)),
    twist=st.tuples(SPEED, SPEED, SPEED),
    duration=st.floats(0.001, 3),
)
def test_constant_twist_matches_solve_ivp(pose: tuple[float, ...], twist: tuple[float, ...], duration: float) -> None:
    held = np.array(twist)
    solution = solve_ivp(lambda _, state: _moved(state, held), (0, duration), np.array(pose), rtol=1e-11, atol=1e-12).y[
        :, -1
    ]
    moved = integrate(np.array(pose), held, duration)
    np.testing.assert_allclose(moved[:2], solution[:2], atol=1e-8)
    assert _angle_between(moved[2], solution[2]) < 1e-9
    assert -np.pi <= moved[2] < np.pi


@pytest.mark.parametrize("speed", [5e-324, 1e-322, 1e-310, 1e-300])
def test_a_robot_that_hardly_moves_any_more_comes_to_rest(speed: float) -> None:
    """Lag leaves such speeds after a minute without a command; no product of them may be divided by."""
    lagging = Drive(lag=0.1, max_acceleration=1.0)
    poses, velocities = steer(np.zeros(3), np.array([speed, 0.0, -speed]), np.zeros(3), lagging, 0.01)
    np.testing.assert_allclose(poses, 0.0, atol=1e-300)
    assert (np.abs(velocities) <= speed).all()


@pytest.mark.parametrize("turn", [0.0, 1e-300, 1e-12, 1e-8, 1e-4])
def test_slow_turns_lose_no_digits(turn: float) -> None:
    moved = integrate(np.zeros(3), np.array([1.0, 0.0, turn]), 2.0)
    # To second order, an arc of length 2 turns aside by half its turn.
    np.testing.assert_allclose(moved, [2 * (1 - (2 * turn) ** 2 / 6), 2 * turn, 2 * turn], rtol=1e-8, atol=1e-300)


def test_motions_compose_and_full_turns_close() -> None:
    rng = np.random.default_rng(0)
    poses, twists = rng.normal(size=(4, 5, 3)), rng.normal(size=(4, 5, 3))
    twice = integrate(integrate(poses, twists, 0.4), twists, 0.7)
    np.testing.assert_allclose(twice, integrate(poses, twists, 1.1), atol=1e-12)
    np.testing.assert_allclose(integrate(twice, -twists, 1.1)[..., :2], poses[..., :2], atol=1e-12)
    closed = integrate(np.array([1.0, 2.0, 0.5]), np.array([0.3, 0.2, np.pi]), 2.0)
    np.testing.assert_allclose(closed, [1.0, 2.0, 0.5], atol=1e-12)


def test_headings_are_wrapped() -> None:
    headings = np.array([np.pi, -np.pi, 3 * np.pi, -np.pi - 1e-16, np.nextafter(-np.pi, -9), 100.0])
    poses = np.stack([np.zeros(6), np.zeros(6), headings], axis=-1)
    wrapped = integrate(poses, np.zeros((6, 3)), 0.0)[:, 2]
    assert np.all((wrapped >= -np.pi) & (wrapped < np.pi))
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * headings), atol=1e-12)


@settings(deadline=None, max_examples=60)
@given(twist=st.tuples(SPEED, SPEED, SPEED))
def test_limits(twist: tuple[float, float, float]) -> None:
    given_twist = np.array(twist)
    limited = limit_twists(given_twist, Drive(max_speed=0.5, max_turn_rate=1.0))
    assert np.hypot(*limited[:2]) <= 0.5 + 1e-12
    assert abs(limited[2]) <= 1.0
    assert given_twist[0] * limited[1] == pytest.approx(given_twist[1] * limited[0], abs=1e-12)
    assert given_twist[:2] @ limited[:2] >= 0
    if np.hypot(*given_twist[:2]) < 0.5:
        np.testing.assert_array_equal(limited[:2], given_twist[:2])
    capped = limit_twists(given_twist, Drive(max_speed=0.5, max_axis_speed=0.1))
    np.testing.assert_array_equal(capped[:2], np.clip(limited[:2], -0.1, 0.1))
    assert capped[2] == given_twist[2]


def test_lag_in_closed_form() -> None:
    drive = Drive(lag=0.2)
    pose, velocity = np.zeros(3), np.zeros(3)
    command = np.array([0.3, -0.1, 0.0])
    pose, velocity = steer(pose, velocity, command, drive, 0.5)
    np.testing.assert_allclose(velocity, command * (1 - np.exp(-2.5)), atol=1e-15)
    np.testing.assert_allclose(pose[:2], command[:2] * (0.5 - 0.2 * (1 - np.exp(-2.5))), atol=1e-15)


def test_acceleration_limit_in_closed_form() -> None:
    drive = Drive(max_speed=1.0, max_acceleration=0.5, max_turn_acceleration=2.0)
    pose, velocity = steer(np.zeros(3), np.zeros(3), np.array([0.6, 0.8, 0.0]), drive, 1.0)
    np.testing.assert_allclose(velocity[:2], [0.3, 0.4], atol=1e-15)
    np.testing.assert_allclose(pose[:2], [0.15, 0.2], atol=1e-15)
    pose, velocity = steer(pose, velocity, np.array([0.6, 0.8, 0.0]), drive, 3.0)
    np.testing.assert_allclose(velocity[:2], [0.6, 0.8], atol=1e-15)
    # 1 m on the ramp of 2 s, then 2 s at 1 m/s.
    np.testing.assert_allclose(pose[:2], [1.8, 2.4], atol=1e-14)
    _, velocity = steer(np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 5.0]), drive, 0.5)
    assert velocity[2] == pytest.approx(1.0)


@pytest.mark.parametrize(
    "drive",
    [
        Drive(lag=0.15),
        Drive(max_acceleration=0.7, max_turn_acceleration=1.5),
        Drive(lag=0.3, max_acceleration=0.8, max_turn_acceleration=2.0),
    ],
)
def test_limited_lag_matches_solve_ivp(drive: Drive) -> None:
    command, velocity = np.array([0.3, -0.35, 1.2]), np.array([-0.4, 0.1, -0.8])
    tiny = 1e-5

    def slope(gap: Array, limit: float) -> Array:
        wanted = gap / max(drive.lag, tiny)
        size = np.linalg.norm(wanted)
        return wanted if size <= limit else wanted * (limit / size)

    def derivative(_: float, state: Array) -> Array:
        gap = command - state[3:]
        change = [*slope(gap[:2], drive.max_acceleration), *slope(gap[2:], drive.max_turn_acceleration)]
        return np.array([*_moved(state[:3], state[3:]), *change])

    solution = solve_ivp(
        derivative, (0, 1.0), np.concatenate([np.zeros(3), velocity]), method="LSODA", rtol=1e-9, atol=1e-10
    ).y[:, -1]
    errors = []
    for steps in (50, 100):
        pose, now = np.zeros(3), velocity
        for _ in range(steps):
            pose, now = steer(pose, now, command, drive, 1.0 / steps)
        np.testing.assert_allclose(now, solution[3:], atol=2e-5)
        assert pose[2] == pytest.approx(solution[2], abs=2e-5)
        errors.append(np.linalg.norm(pose[:2] - solution[:2]))
    # The pose is second order in the step, down to what the oracle itself resolves.
    assert errors[0] < 1e-4
    assert errors[1] < errors[0] / 3 + 2e-5


@settings(deadline=None, max_examples=40)
@given(st.floats(0, 1), st.floats(0.05, 2), st.floats(0.001, 0.5), st.floats(0.001, 0.5))
def test_velocity_does_not_depend_on_the_step(lag: float, limit: float, first: float, second: float) -> None:
    drive = Drive(lag=lag, max_acceleration=limit)
    start, command = np.array([0.2, -0.3, 0.0]), np.array([-0.3, 0.3, 0.0])
    split = steer(*steer(np.zeros(3), start, command, drive, first), command, drive, second)
    whole = steer(np.zeros(3), start, command, drive, first + second)
    np.testing.assert_allclose(split, whole, atol=1e-12)


def test_shapes_are_checked() -> None:
    with pytest.raises(ConfigurationError, match="same shape"):
        integrate(np.zeros((2, 3)), np.zeros((3, 3)), 1.0)
    with pytest.raises(ConfigurationError, match="same shape"):
        steer(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((1, 3)), Drive(), 1.0)
