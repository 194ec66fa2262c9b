"""What rays hit against Shapely, and intensities that change no range."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import LineString, Point, affinity

from triform.simulation import (
    HARDWARE,
    IDEAL,
    ROBOMASTER_EP,
    Arena,
    Mounting,
    Placement,
    Profile,
    World,
    arena_toml,
    cast_rolling,
    cast_scans,
    get_arena,
    get_profile,
    profile_toml,
)
from triform.simulation.intensity import Brightness
from triform.types import ConfigurationError, ScanConfig

BRIGHT = {"robot": 250.0, "obstacle": 120.0, "noise": 5.0}


def measuring(profile: Profile, **brightness: float) -> Profile:
    """A robot that asks for intensities."""
    model = Brightness(**(BRIGHT | brightness))
    return replace(profile, lidar=replace(profile.lidar, min_intensity=230.0, brightness=model))


def scene(rng: np.random.Generator) -> Arena:
    walls = rng.uniform(-2.5, 2.5, (4, 4))
    pillars = np.column_stack([rng.uniform(-2, 2, (3, 2)), rng.uniform(0.05, 0.3, 3)])
    return Arena("scene", walls, pillars)


def box(pose: np.ndarray) -> shapely.Polygon:
    outline = affinity.rotate(shapely.box(-0.16, -0.12, 0.16, 0.12), pose[2], (0, 0), use_radians=True)
    return affinity.translate(outline, *pose[:2])


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), moving=st.booleans())
def test_hits_are_what_shapely_finds_at_the_end_of_a_ray(seed: int, moving: bool) -> None:
    rng = np.random.default_rng(seed)
    start = rng.uniform([-2, -2, -np.pi], [2, 2, np.pi], (1, 4, 3))
    end = start + (rng.uniform(-0.2, 0.2, start.shape) if moving else 0.0)
    arena, config = scene(rng), ScanConfig(rays=61, range_min=0.0, range_max=2.0)
    hits = np.full((1, 4, 61), 99, np.int32)
    ranges = cast_rolling(start, end, np.ones((1, 4), bool), ROBOMASTER_EP, arena, config, hits=hits)
    lines = [LineString(wall.reshape(2, 2)) for wall in arena.walls]
    circles = [Point(x, y).buffer(r, quad_segs=500) for x, y, r in arena.pillars]
    for i in range(4):
        for k, angle in enumerate(config.angles):
            if not ranges[0, i, k] < np.inf:
                assert hits[0, i, k] == -1
                continue
            poses = start[0] + k / 61 * (end[0] - start[0])
            x, y, heading = poses[i]
            tip = Point(
                x + ranges[0, i, k] * math.cos(heading + angle), y + ranges[0, i, k] * math.sin(heading + angle)
            )
            robots = shapely.union_all([box(pose) for j, pose in enumerate(poses) if j != i])
            apart = [tip.distance(each) for each in (*lines, *circles, robots)]
            assert apart[hits[0, i, k]] < 1e-4


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_asking_for_hits_does_not_change_a_ray(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses, active = rng.uniform(-2, 2, (2, 5, 3)), rng.random((2, 5)) < 0.8
    offsets = rng.normal(0, 0.01, (2, 5, 90))
    place = (poses, active, ROBOMASTER_EP, scene(rng), ScanConfig(rays=90), offsets)
    hits = np.empty((2, 5, 90), np.int32)
    np.testing.assert_array_equal(cast_scans(*place, hits=hits), cast_scans(*place))
    assert (hits[~active] == -1).all()


ROLLING = replace(
    HARDWARE, lidar=replace(HARDWARE.lidar, angle_noise=0.002), mounting=Mounting(x=0.05, blind_sectors=((100, 120),))
)


@pytest.mark.parametrize("profile", [HARDWARE, ROLLING], ids=["hardware", "off the centre"])
def test_intensities_change_no_range_and_no_command(profile: Profile) -> None:
    """Their noise has a stream of its own: ranges are the same to the bit, in robots that come and go."""
    rng = np.random.default_rng(2)
    poses = np.array([[[0.0, 0.0, 0.3], [1.0, 0.1, 2.0], [0.2, 0.9, -1.0]]] * 2)
    arena = Arena("one", np.array([[-1.5, -2.0, -1.5, 2.0]]), np.array([[0.9, -0.9, 0.2]]))
    plain = World(poses, profile, arena, [3, 4])
    bright = World(poses, measuring(profile), arena, [3, 4])
    for step in range(12):
        commands = rng.uniform(-0.1, 0.1, plain.poses.shape)
        for world in (plain, bright):
            world.apply(commands, 0.125)
            if step == 5:
                world.remove_robot(0, 1)
                world.add_robot(1, np.array([-0.8, -0.9, 0.0]))
        first, second = plain.observe(), bright.observe()
        np.testing.assert_array_equal(first.scans.ranges, second.scans.ranges)
        if step == 5:
            commands = rng.uniform(-0.1, 0.1, plain.poses.shape)
    assert first.scans.intensities is None
    assert second.scans.intensities is not None
    assert second.scans.intensities.shape == second.scans.ranges.shape


def test_a_world_shows_how_bright_robots_and_obstacles_are() -> None:
    """A robot ahead, a wall behind, a pillar on the left that says its own intensity, and nothing on the right."""
    arena = Arena("one", np.array([[-1.0, -3.0, -1.0, 3.0]]), np.array([[0.0, 1.2, 0.2]]), pillar_intensities=[60.0])
    poses = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    for base in (IDEAL, HARDWARE):
        robot = measuring(base, falloff=10.0)
        world = World(poses, replace(robot, lidar=replace(robot.lidar, dropout=0.0)), arena, [1])
        for _ in range(8):
            world.apply(np.zeros((1, 2, 3)), 0.125)
        view = world.observe()
        assert view.scans.intensities is not None
        levels, ranges = view.scans.intensities[0, 0], view.scans.ranges[0, 0]
        angles = np.degrees(view.scans.config.angles)
        for degrees, level, distance in ((0, 250, 0.84), (90, 60, 1.0), (178, 120, 1.0)):
            near = np.abs(angles - degrees) < 5
            assert abs(levels[near].mean() - (level - 10 * distance)) < 5
            assert 2 < levels[near].std() < 8
            assert np.isfinite(ranges[near]).all()
        assert (levels[np.abs(angles + 60) < 5] == 0).all()


@settings(deadline=None, max_examples=40)
@given(st.floats(-0.15, 0.15), st.floats(-0.15, 0.15), st.integers(0, 2**32 - 1))
def test_from_the_base_a_return_keeps_its_intensity(x: float, y: float, seed: int) -> None:
    """Three pillars of three intensities, apart from each other: none is mixed up with another."""
    rng = np.random.default_rng(seed)
    bearings = rng.uniform(-3, 3) + np.array([0, 2.1, 4.2]) + rng.uniform(-0.3, 0.3, 3)
    pillars = np.stack([*(rng.uniform(0.6, 1.7, 3) * (np.cos(bearings), np.sin(bearings))), np.full(3, 0.15)], axis=-1)
    scan = ScanConfig()
    wide, hits = replace(scan, range_max=2.0 + math.hypot(x, y)), np.empty((1, 1, 450), np.int32)
    place = (np.zeros((1, 1, 3)), np.ones((1, 1), bool), ROBOMASTER_EP, Arena(pillars=pillars), wide)
    eye = cast_scans(*place, eye=(x, y), hits=hits)
    seen, levels = Placement(scan, Mounting(x, y)).from_base(eye, np.array([10.0, 20.0, 30.0, 0.0])[hits])
    assert levels is not None
    np.testing.assert_array_equal(seen, Placement(scan, Mounting(x, y)).from_base(eye)[0])
    returned = np.isfinite(seen[0, 0])
    directions = np.stack([np.cos(scan.angles), np.sin(scan.angles)], axis=-1)[returned]
    tips = seen[0, 0, returned, None] * directions
    nearest = np.linalg.norm(tips[:, None] - pillars[:, :2], axis=-1).argmin(axis=-1)
    np.testing.assert_array_equal(levels[0, 0, returned], 10.0 * (1 + nearest))
    assert (levels[0, 0, ~returned] == 0).all()


def test_profiles_and_arenas_with_intensities_are_read_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    for profile in (measuring(HARDWARE), replace(IDEAL, lidar=replace(IDEAL.lidar, intensities=False))):
        path.write_text(profile_toml(profile))
        assert get_profile(str(path)) == profile
    arena = Arena("hall", np.eye(4)[:3], np.ones((2, 3)), [1.5, np.nan, 200.0], [np.nan, 7.0])
    path.write_text(arena_toml(arena))
    found = get_arena(str(path))
    assert replace(Arena("bare", np.eye(4)), walls=np.eye(4)[:2]).levels(Brightness()).shape == (4,)
    np.testing.assert_array_equal(found.wall_intensities, arena.wall_intensities)
    np.testing.assert_array_equal(found.pillar_intensities, arena.pillar_intensities)
    path.write_text("walls = [[0, 0, 1, 0]]\nboxes = [{center = [1, 1], length = 1, width = 1, intensity = 30}]")
    np.testing.assert_array_equal(get_arena(str(path)).levels(Brightness()), [200, 30, 30, 30, 30, 250, np.nan])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("lidar.min_intensity = -1", "table lidar: min_intensity is -1.0; it must be finite and not negative"),
        (
            "lidar.intensities = false\nlidar.min_intensity = 9",
            "table lidar: min_intensity is 9.0, but this LiDAR does",
        ),
        ("lidar.brightness.robot = 300", "table lidar.brightness: robot is 300.0; it must lie between 0 and 255"),
        ("lidar.brightness.tape = 3", "no key 'lidar.brightness.tape'; allowed are robot, obstacle, falloff"),
    ],
)
def test_intensities_that_cannot_be_are_refused(content: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(content)
    with pytest.raises(ConfigurationError, match=says):
        get_profile(str(path))
    with pytest.raises(ConfigurationError, match="wall_intensities of shape"):
        Arena("hall", np.eye(4)[:3], wall_intensities=[1.0])
    for level in (-1.0, np.inf):
        with pytest.raises(ConfigurationError, match=f"^one of wall_intensities is {level:g}; it must be finite"):
            Arena("hall", [[0, 0, 1, 1]], wall_intensities=[level])
