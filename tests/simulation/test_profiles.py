"""Footprints, profiles and arenas refuse what makes no sense."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from triform.evaluation.scenario import Scenario
from triform.robots.drive import DriveConfig
from triform.robots.emulate import EmulateConfig
from triform.simulation import (
    HARDWARE,
    PROFILES,
    ROBOMASTER_EP,
    Arena,
    Drive,
    Footprint,
    LidarConfig,
    NoiseBand,
    constant_noise,
    get_arena,
    get_profile,
    noise_sigma,
)
from triform.types import ConfigurationError, ScanConfig, TriformError


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Footprint("triangle", 1, 1), "'triangle'"),  # type: ignore[arg-type]
        (lambda: Footprint.box(0.0, 1.0), "0.0 m x 1.0 m"),
        (lambda: Footprint.box(math.nan, 1.0), "nan m"),
        (lambda: Footprint("circle", 1.0, 2.0), "diameter"),
        (lambda: NoiseBand(0.0), "ends at 0.0 m"),
        (lambda: NoiseBand(1.0, absolute=-0.1), "-0.1 m"),
        (lambda: NoiseBand(1.0, relative=math.nan), "nan x range"),
        (lambda: LidarConfig(noise=(NoiseBand(1.0),)), "must reach inf"),
        (lambda: LidarConfig(noise=(NoiseBand(math.inf), NoiseBand(1.0))), "must grow"),
        (lambda: LidarConfig(angle_noise=-1.0), "angle_noise is -1.0"),
        (lambda: LidarConfig(dropout=1.1), "dropout is 1.1"),
        (lambda: LidarConfig(period=0.0), "period is 0.0 s"),
        (lambda: Drive(max_speed=0.0), "max_speed is 0.0"),
        (lambda: Drive(max_acceleration=math.nan), "max_acceleration is nan"),
        (lambda: Drive(lag=math.inf), "lag is inf"),
        (lambda: replace(get_profile("ideal"), control_period=-1.0), "control_period is -1.0"),
        (lambda: replace(get_profile("ideal"), time_step=math.inf), "time_step is inf"),
        (lambda: replace(get_profile("ideal"), latency=-0.1), "latency is -0.1"),
        (lambda: Arena("bad", np.zeros((2, 3))), "table of 4 finite columns"),
        (lambda: Arena("bad", np.full((1, 4), np.nan)), "table of 4 finite columns"),
        (lambda: Arena("bad", np.ones((1, 4))), "no length"),
        (lambda: Arena.room(0.0, 1.0), "0.0 m x 1.0 m"),
        (lambda: Arena(pillars=np.array([[0, 0, 0]])), "radius of a circle must be positive"),
        (lambda: Arena(pillars=np.array([0, 0, 1])), "a table of 3 finite columns"),
    ],
)
def test_bad_values_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message.replace(".", r"\.")):
        make()


def test_names_are_looked_up() -> None:
    for name in PROFILES:
        assert get_profile(name).name == name
    with pytest.raises(TriformError, match=r"there are ideal, hardware, .* and your own"):
        get_profile("perfect")
    assert get_arena("room-6").walls.shape == (4, 4)
    assert get_arena("pillars").pillars.shape == (4, 3)
    with pytest.raises(TriformError, match="there are open, room-6, pillars, living-room and your own"):
        get_arena("maze")


def test_hardware_is_what_the_data_sheets_say() -> None:
    profile = get_profile("hardware")
    assert profile.lidar.scan.rays == 667
    assert profile.lidar.period == pytest.approx(0.167, abs=1e-3)
    assert profile.lidar.rolling
    assert profile.lidar.dropout == 0.01
    assert (profile.control_period, profile.latency) == (0.125, 0.12)
    assert profile.drive.max_axis_speed == 0.1
    assert profile.drive.lag > 0


def test_shipped_profiles_are_those_of_their_sources() -> None:
    burger, waffle, create3 = (get_profile(name) for name in ("turtlebot3-burger", "turtlebot3-waffle", "turtlebot4"))
    # A wheel that turns the robot on the spot as fast as the manuals say is about as fast as both are straight on.
    for robot in (burger, waffle):
        assert robot.drive.max_turn_rate * robot.drive.track / 2 == pytest.approx(robot.drive.max_speed, rel=0.05)
        assert robot.drive.max_wheel_speed == robot.drive.max_speed
        assert robot.lidar.period == 0.2
    # Two wheels that speed up against each other turn the robot.
    for robot in (burger, waffle, create3):
        largest = 2 * robot.drive.max_acceleration / robot.drive.track
        assert robot.drive.max_turn_acceleration == pytest.approx(largest, rel=0.01)
        assert robot.footprint.is_circle
        assert robot.mounting.x < 0
    assert not get_profile("rosbot-xl").drive.is_differential
    assert get_profile("turtlebot3-waffle-lds01").lidar.scan.range_min == 0.12


def test_differential_bases_are_refused_where_nothing_drives_them() -> None:
    for make in (
        lambda: Scenario(profile="turtlebot4", simulator="gazebo"),
        lambda: DriveConfig(profile="turtlebot4"),
        lambda: EmulateConfig(profile="turtlebot3-burger"),
    ):
        with pytest.raises(ConfigurationError, match=r"has a differential base, and .* drives holonomic robots alone"):
            make()


def test_footprints() -> None:
    assert ROBOMASTER_EP.circumradius == pytest.approx(0.2)
    np.testing.assert_allclose(ROBOMASTER_EP.corners[0], [0.16, 0.12])
    disc = Footprint.circle(0.3)
    assert disc.circumradius == 0.15
    assert constant_noise(0.01)[0].up_to == math.inf


@pytest.mark.parametrize("reach", [0.4, 0.8, 3.0, 8.0])
@pytest.mark.parametrize(
    "noise", [(), constant_noise(0.02), HARDWARE.lidar.noise, (NoiseBand(1, 0.03), NoiseBand(math.inf))]
)
def test_the_largest_noise_is_that_of_the_worst_range(reach: float, noise: tuple[NoiseBand, ...]) -> None:
    lidar = LidarConfig(ScanConfig(range_max=reach), noise)
    assert lidar.largest_noise == pytest.approx(noise_sigma(np.linspace(1e-6, reach, 10_000), noise).max(), abs=1e-5)


def test_rooms_close() -> None:
    room = Arena.room(4.0, 2.0, center=(1.0, -1.0))
    np.testing.assert_array_equal(room.walls[:, 2:], np.roll(room.walls[:, :2], -1, axis=0))
    assert room.walls[:, [0, 2]].min() == -1.0
    assert room.walls[:, [1, 3]].max() == 0.0
