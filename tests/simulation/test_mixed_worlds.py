"""Worlds of several kinds of robots: each robot is what it would be among its own kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.mixed import MixedView
from triform.simulation import HARDWARE, IDEAL, PROFILES, Composition, World, get_arena, make_world, sample_starts
from triform.types import ConfigurationError, TriformError

BURGER, TURTLEBOT4 = PROFILES["turtlebot3-burger"], PROFILES["turtlebot4"]
#: Rolling and instant LiDARs, both kinds of bases, boxes and circles, control periods of 0.125 s and 0.1 s.
MIXED = Composition((HARDWARE, TURTLEBOT4, IDEAL), (2, 2, 1))


def _drive(world: World, seconds: float, seed: int = 0) -> None:
    """Random commands, those of each robot the same in every team and held for a second."""
    robots = world.poses.shape[1]
    for second in range(round(seconds)):
        rng = np.random.default_rng([seed, second])
        commands = np.stack([rng.normal(0, 0.1, 3) for _ in range(robots)])[None]
        for _ in range(round(1 / world.control_period)):
            world.apply(commands, world.control_period)


def test_kinds_of_one_profile_are_one_kind() -> None:
    """Poses, contacts, scans with their noise, odometry and exploration noise, to the bit."""
    poses, arena = sample_starts(5, 2, 1), get_arena("pillars")
    taped = replace(HARDWARE.lidar, angle_noise=0.01, min_intensity=150.0)
    at_once = replace(taped, rolling=False)
    for profile in (HARDWARE, TURTLEBOT4, replace(IDEAL, lidar=taped), replace(TURTLEBOT4, lidar=at_once)):
        one = World(poses, profile, arena, seeds=[3, 4])
        two = World(poses, Composition((profile, profile), (2, 3)), arena, seeds=[3, 4])
        for _ in range(10):
            seen, parts = one.observe(), two.observe()
            assert isinstance(parts, MixedView)
            for part, robots in zip(parts.parts, parts.robots, strict=True):
                np.testing.assert_array_equal(part.scans.ranges, seen.scans.ranges[:, robots])
                if seen.scans.intensities is not None:
                    np.testing.assert_array_equal(part.scans.intensities, seen.scans.intensities[:, robots])
                    assert (part.scans.intensities > 0).any()
            for name in ("poses", "noise", "odometry", "active", "time"):
                np.testing.assert_array_equal(getattr(parts, name), getattr(seen, name))
            commands = np.random.default_rng(5).normal(0, 0.1, (2, 5, 3))
            one.apply(commands, profile.control_period)
            two.apply(commands, profile.control_period)
        for name in ("poses", "velocities", "min_distance", "collided", "hit_arena"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_each_kind_drives_and_senses_as_its_profile_says() -> None:
    """Far from each other robots move as alone, with the noise of their own place in the team."""
    poses = np.array([[[10.0 * robot, 0.0, 0.3 * robot] for robot in range(5)]])
    mixed = World(poses, MIXED, seeds=[3])
    _drive(mixed, 3)
    view = mixed.observe()
    assert isinstance(view, MixedView)
    assert mixed.control_period == pytest.approx(1 / 40)
    for profile, part, robots in zip(MIXED.profiles, view.parts, view.robots, strict=True):
        own = World(poses, profile, seeds=[3])
        # Its commands come at its own period, of which a second holds a whole number.
        _drive(own, 3)
        alone = own.observe()
        assert part.scans.config == profile.lidar.scan
        # The common step cuts the integration of bases with a lag in other places.
        np.testing.assert_allclose(part.poses, alone.poses[:, robots], atol=1e-4)
        np.testing.assert_allclose(part.noise, alone.noise[:, robots], atol=1e-4)
        # Nobody is near: only dropped rays differ from no return, and they are drawn by the robot's own generator.
        np.testing.assert_array_equal(part.scans.ranges, alone.scans.ranges[:, robots])


def test_robots_of_each_kind_see_each_other_as_they_are() -> None:
    poses = np.array([[[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]]])
    outlines = {"box": replace(IDEAL, footprint=HARDWARE.footprint), "disc": replace(IDEAL, footprint=BURGER.footprint)}
    world = World(poses, Composition(tuple(outlines.values()), (1, 2)))
    box, disc = (part.scans for part in world.observe().parts)
    front, left = 225, 225 + 112
    assert box.ranges[0, 0, front] == pytest.approx(1 - BURGER.footprint.half_length, abs=1e-6)
    assert box.ranges[0, 0, left : left + 2].min() == pytest.approx(1 - BURGER.footprint.half_length, abs=1e-3)
    assert disc.ranges[0, 0, 0] == pytest.approx(1 - HARDWARE.footprint.half_length, abs=1e-6)


def test_commands_are_taken_at_each_kinds_own_period() -> None:
    world = World(np.array([[[0.0, 0, 0], [5.0, 0, 0]]]), Composition((HARDWARE, BURGER), (1, 1)), seeds=[1])
    taken = []
    for tick in range(41):
        view = world.observe()
        taken.append(view.due)
        world.apply(np.full((1, 2, 3), 0.001 * (tick + 1)), world.control_period)
        held = world.observe().held[0, :, 0]
        for kind, period in enumerate((5, 4)):
            assert held[kind] == pytest.approx(0.001 * (tick // period * period + 1))
    assert [sum(column) for column in zip(*taken, strict=True)] == [9, 11]


def test_who_joins_is_of_the_kind_whose_place_it_takes() -> None:
    poses = np.array([[[float(robot), 0, 0] for robot in range(5)]])
    world = World(poses, MIXED, seeds=[3])
    _drive(world, 1)
    world.remove_robot(0, 1)
    assert world.add_robot(0, [1.0, 3.0, 0.0]) == 1
    assert world.newcomer is IDEAL
    assert world.add_robot(0, [2.0, 3.0, 0.0]) == 5
    _drive(world, 1)
    view = world.observe()
    assert [part.active.shape[1] for part in view.parts] == [2, 2, 2]
    assert np.isfinite(view.parts[2].scans.ranges[0, 1]).any()
    assert view.active.all()


def test_a_mixed_view_has_no_common_scans() -> None:
    view = World(sample_starts(5, 1, 1), MIXED, seeds=[3]).observe()
    with pytest.raises(TriformError, match="no common scans"):
        _ = view.scans
    with pytest.raises(ConfigurationError, match="each part needs its own"):
        MixedView(view.parts, [True], view.held)
    with pytest.raises(ConfigurationError, match="held commands of shape"):
        MixedView(view.parts, view.due, view.held[:, :3])


@pytest.mark.parametrize(
    ("text", "names", "counts"),
    [
        ("ideal", ["ideal"], None),
        ("turtlebot4:3", ["turtlebot4"], (3,)),
        (" turtlebot4:3  hardware:2 ", ["turtlebot4", "hardware"], (3, 2)),
    ],
)
def test_compositions_are_read(text: str, names: list[str], counts: tuple[int, ...] | None) -> None:
    found = Composition.parse(text)
    assert ([profile.name for profile in found.profiles], found.counts) == (names, counts)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("hardware turtlebot4", "each names its number"),
        ("turtlebot4:3 hardware", "each names its number"),
        ("hardware turtlebot4:3", "each names its number"),
        ("hardwear:2 ideal:1", "did you mean 'hardware'"),
        ("ideal:0 hardware:2", "each has at least 1"),
        ("", "there is no profile"),
    ],
)
def test_what_is_no_composition_is_refused(text: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        Composition.parse(text)


@given(st.lists(st.sampled_from([0.1, 0.125, 0.05, 0.13, 1 / 6, 1 / 3]), min_size=1, max_size=4))
@settings(max_examples=50, deadline=None)
def test_the_common_step_divides_every_control_period(periods: list[float]) -> None:
    kinds = tuple(replace(IDEAL, control_period=period) for period in periods)
    step = Composition(kinds, (1,) * len(kinds)).control_period
    for period in periods:
        assert period / step == pytest.approx(round(period / step), abs=1e-6)


def test_teams_have_as_many_robots_as_their_profiles_say() -> None:
    world = make_world(profile="turtlebot4:3 hardware:2")
    assert world.poses.shape == (1, 5, 3)
    assert make_world(profile="turtlebot4:3").profile.name == "turtlebot4"
    with pytest.raises(ConfigurationError, match="this works with one"):
        _ = world.profile
    with pytest.raises(ConfigurationError, match="the profiles have 5 robots"):
        make_world(9, profile="turtlebot4:3 hardware:2")
    with pytest.raises(ConfigurationError, match="a team has 4 robots"):
        World(sample_starts(4, 1, 1), MIXED, seeds=[1])
    with pytest.raises(ConfigurationError, match="no common step"):
        Composition((IDEAL, replace(IDEAL, control_period=0.1003)), (1, 1))
    with pytest.raises(ConfigurationError, match="a number for each profile"):
        Composition((IDEAL, HARDWARE))
