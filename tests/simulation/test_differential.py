"""Differential bases: SciPy's integration of two driven wheels, and what a wanted velocity becomes on them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from triform.simulation import IDEAL, Drive, World, integrate, limit_twists, steer
from triform.simulation.noise import noise_in_body, noise_keys, noise_period, noise_scale
from triform.simulation.odometry import resting_poses
from triform.types import NOISE_PERIOD, ConfigurationError, FloatArray

TRACK = 0.2
ROLLING = Drive(max_speed=0.3, max_turn_rate=2.0, kind="differential", track=TRACK)
seeds = st.integers(0, 2**32 - 1)
velocity = st.floats(-1, 1)
drives = st.builds(
    Drive,
    max_speed=st.floats(0.05, 1),
    max_turn_rate=st.floats(0.2, 5),
    max_wheel_speed=st.floats(0.05, 1),
    track=st.floats(0, 0.5),
    reverse=st.booleans(),
    kind=st.just("differential"),
)


def angle_between(first: float, second: float) -> float:
    return float(abs((first - second + np.pi) % (2 * np.pi) - np.pi))


@settings(deadline=None, max_examples=30)
@given(left=st.floats(-0.25, 0.25), right=st.floats(-0.25, 0.25), heading=st.floats(-3.1, 3.1))
def test_wheels_leave_the_arcs_of_solve_ivp(left: float, right: float, heading: float) -> None:
    """The robot's centre is midway between two wheels, each of which rolls straight on by itself."""

    def rolls(_: float, state: FloatArray) -> FloatArray:
        turn = state[2]
        return np.array(
            [0.5 * (left + right) * np.cos(turn), 0.5 * (left + right) * np.sin(turn), (right - left) / TRACK]
        )

    solution = solve_ivp(rolls, (0, 1.5), [0.3, -0.2, heading], rtol=1e-11, atol=1e-12).y[:, -1]
    world = World([[[0.3, -0.2, heading]]], replace(IDEAL, drive=replace(ROLLING, max_turn_rate=9.0)))
    command = np.array([[[0.5 * (left + right), 0.0, (right - left) / TRACK]]])
    for _ in range(15):
        world.apply(command, 0.1)
    np.testing.assert_allclose(world.poses[0, 0, :2], solution[:2], atol=1e-9)
    assert angle_between(world.poses[0, 0, 2], solution[2]) < 1e-9


@pytest.mark.parametrize(
    "slow",
    [{"lag": 0.15}, {"max_acceleration": 0.7, "max_turn_acceleration": 3.0},
     {"lag": 0.1, "max_acceleration": 0.9, "max_turn_acceleration": 7.7}],
)  # fmt: skip
def test_slow_wheels_match_solve_ivp(slow: dict[str, float]) -> None:
    drive = replace(ROLLING, **slow)
    start, command = np.array([-0.25, 0.0, 1.5]), np.array([0.3, 0.0, -1.8])

    def towards(gap: float, limit: float) -> float:
        return float(np.clip(gap / max(drive.lag, 1e-5), -limit, limit))

    def rolls(_: float, state: FloatArray) -> list[float]:
        _, _, turn, along, rate = state
        faster = towards(command[0] - along, drive.max_acceleration)
        return [
            along * np.cos(turn), along * np.sin(turn), rate, faster,
            towards(command[2] - rate, drive.max_turn_acceleration),
        ]  # fmt: skip

    initial = [0.0, 0.0, 0.4, start[0], start[2]]
    solution = solve_ivp(rolls, (0, 1.0), initial, method="LSODA", rtol=1e-9, atol=1e-10).y[:, -1]
    pose, now = np.array([0.0, 0.0, 0.4]), start
    for _ in range(200):
        pose, now = steer(pose, now, command, drive, 0.005)
    np.testing.assert_allclose(now, [solution[3], 0.0, solution[4]], atol=2e-5)
    np.testing.assert_allclose(pose[:2], solution[:2], atol=3e-5)
    assert angle_between(pose[2], solution[2]) < 3e-5


@settings(deadline=None, max_examples=200)
@given(twist=st.tuples(velocity, velocity, st.floats(-3, 3)), drive=drives)
def test_what_is_driven_is_within_the_limits_and_driven_again_as_it_is(
    twist: tuple[float, float, float], drive: Drive
) -> None:
    driven = limit_twists(np.array(twist), drive)
    assert driven[1] == 0.0
    assert abs(driven[0]) <= min(drive.max_speed, math.hypot(*twist[:2])) + 1e-12
    assert abs(driven[2]) <= drive.max_turn_rate
    assert abs(driven[0]) + 0.5 * drive.track * abs(driven[2]) <= drive.max_wheel_speed * (1 + 1e-12)
    assert drive.reverse or driven[0] >= 0.0
    # It never drives away from where it is to go, and turns towards it.
    assert driven[0] * twist[0] >= -1e-12
    np.testing.assert_allclose(limit_twists(driven, drive), driven, atol=1e-15)
    mirrored = limit_twists(np.array(twist) * [1, -1, -1], drive)
    if abs(twist[0]) > 1e-9 or twist[1] == 0.0:
        np.testing.assert_allclose(mirrored, driven * [1, -1, -1], atol=1e-12)


@settings(deadline=None, max_examples=60)
@given(
    angle=st.floats(-np.pi, np.pi), speed=st.floats(0.05, 0.3), reverse=st.booleans(), start=st.floats(-np.pi, np.pi)
)
def test_a_robot_comes_to_drive_where_it_is_to_go(angle: float, speed: float, reverse: bool, start: float) -> None:
    """A velocity that stays the same in the world: after a while the robot has it, whatever its heading was."""
    drive = replace(ROLLING, reverse=reverse)
    pose, now = np.array([0.0, 0.0, start]), np.zeros(3)
    wanted = speed * np.exp(1j * angle)
    for _ in range(60):
        body = wanted * np.exp(-1j * pose[2])
        pose, now = steer(pose, now, np.array([body.real, body.imag, 0.0]), drive, 0.1)
    got = now[0] * np.exp(1j * pose[2])
    assert abs(got - wanted) < 1e-2 * speed
    assert reverse or now[0] > 0


def test_a_wheel_that_is_too_fast_slows_the_whole_arc_down() -> None:
    drive = replace(ROLLING, max_wheel_speed=0.3)
    driven = limit_twists(np.array([0.3, 0.0, 2.0]), drive)
    assert driven[0] + 0.5 * TRACK * driven[2] == pytest.approx(0.3)
    assert driven[2] / driven[0] == pytest.approx(2.0 / 0.3)


@settings(deadline=None, max_examples=40)
@given(
    seeds,
    st.sampled_from([math.inf, 0.5, 2.0]),
    st.sampled_from([math.inf, 3.0, 9.0]),
    st.sampled_from([0.0, 0.05, 0.2]),
)
def test_rolling_robots_come_to_rest_where_odometry_says(
    seed: int, acceleration: float, turn_acceleration: float, lag: float
) -> None:
    """Against the drive itself, in small steps, on arcs whose curvature changes while the wheels slow down."""
    rng = np.random.default_rng(seed)
    drive = replace(ROLLING, max_acceleration=acceleration, max_turn_acceleration=turn_acceleration, lag=lag)
    pose = rng.uniform(-3, 3, (3, 3))
    twists = rng.uniform(-1, 1, (3, 3)) * [0.3, 0.0, 2.0]
    expected = resting_poses(pose, twists, drive)
    for _ in range(2000):
        pose, twists = steer(pose, twists, np.zeros((3, 3)), drive, 1e-3)
    np.testing.assert_allclose(pose[:, :2], expected[:, :2], atol=2e-4)
    assert np.abs(np.exp(1j * pose[:, 2]) - np.exp(1j * expected[:, 2])).max() < 1e-3


def test_robots_whose_wheels_stop_at_once_rest_where_they_are() -> None:
    poses = np.random.default_rng(0).uniform(-3, 3, (2, 4, 3))
    np.testing.assert_allclose(resting_poses(poses, np.ones((2, 4, 3)), ROLLING), poses, atol=1e-15)


@settings(deadline=None, max_examples=40)
@given(seeds, st.floats(-np.pi, np.pi), st.booleans())
def test_noise_keeps_its_direction_while_a_robot_turns(seed: int, turn: float, reverse: bool) -> None:
    drive, keys = replace(ROLLING, reverse=reverse), noise_keys([np.random.SeedSequence(seed)], 1)
    before = noise_in_body(keys, drive, 0.0, np.array([[0.5]]))[0, 0] @ [1, 1j]
    later = noise_in_body(keys, drive, 0.9 * noise_period(drive), np.array([[0.5 + turn]]))[0, 0] @ [1, 1j]
    assert before == pytest.approx(later * np.exp(1j * turn))
    # A holonomic robot does not turn, and its noise does not ask for a heading.
    sideways = noise_in_body(keys, Drive(), 0.0, np.array([[0.5]]))
    np.testing.assert_array_equal(sideways, noise_in_body(keys, Drive(), 0.0, np.array([[turn]])))


@settings(deadline=None, max_examples=40)
@given(st.floats(0.02, 2.0))
def test_the_noise_of_a_slow_base_is_smaller_and_lasts_longer(speed: float) -> None:
    slow, share = Drive(max_axis_speed=speed), min(1.0, speed / 0.5)
    assert noise_scale(slow) == pytest.approx(np.sqrt(share))
    assert noise_period(slow) * share == pytest.approx(NOISE_PERIOD)
    keys, sizes = noise_keys([], 200), []
    for drive in (slow, Drive()):
        sizes.append(noise_in_body(keys, drive, 0.0, np.zeros((200, 1))).std())
    assert sizes[0] == pytest.approx(np.sqrt(share) * sizes[1])


def test_noise_lasts_as_long_as_a_turn_needs() -> None:
    assert noise_period(Drive()) == NOISE_PERIOD
    assert noise_period(ROLLING) == pytest.approx(1.5 + 0.25 * np.pi)
    assert noise_period(replace(ROLLING, reverse=False)) == pytest.approx(1.5 + 0.5 * np.pi)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"max_turn_rate": math.inf}, "max_turn_rate is inf"),
        ({"track": -0.1}, "track is -0.1 m"),
        ({"max_wheel_speed": 0.0}, "max_wheel_speed is 0.0"),
        ({"kind": "tracked"}, "kind is 'tracked'"),
    ],
)
def test_impossible_bases_are_refused(bad: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        replace(ROLLING, **bad)  # type: ignore[arg-type]


def test_arcs_are_those_of_constant_twists() -> None:
    pose, now = steer(np.zeros(3), np.array([0.2, 0.0, 1.0]), np.array([0.2, 0.0, 1.0]), ROLLING, 0.7)
    np.testing.assert_allclose(pose, integrate(np.zeros(3), now, 0.7), atol=1e-15)
