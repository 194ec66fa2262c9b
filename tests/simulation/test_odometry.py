"""Odometry: relative poses, and maps of old scans drawn where the robot is now."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from triform.control import drive as drive_team
from triform.control import make_controller
from triform.control.scan_packer import ScanPacker
from triform.policy import PackedMaps
from triform.simulation import IDEAL, Drive, Footprint, Profile, World, integrate, sample_starts, steer
from triform.simulation.odometry import relative_poses, resting_poses
from triform.types import MapConfig, ScanConfig, View

seeds = st.integers(0, 2**32 - 1)
ROUND = replace(IDEAL, footprint=Footprint.circle(0.3), lidar=replace(IDEAL.lidar, scan=ScanConfig(rays=900)))


def random_poses(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(0, 3, (*shape, 2)), rng.uniform(-np.pi, np.pi, (*shape, 1))], axis=-1)


def complex_places(poses: np.ndarray) -> np.ndarray:
    return poses[..., 0] + 1j * poses[..., 1]


@settings(deadline=None, max_examples=60)
@given(seeds)
def test_the_origin_and_the_way_from_it_give_the_pose_back(seed: int) -> None:
    poses, origin = random_poses(seed, (2, 5)), random_poses(seed + 1, (2, 5))
    active = np.random.default_rng(seed).random((2, 5)) < 0.7
    poses[~active], origin[~active] = np.nan, np.nan
    way = relative_poses(poses, origin, active)
    assert not way[~active].any()
    way, poses, origin = way[active], poses[active], origin[active]
    assert ((way[:, 2] >= -np.pi) & (way[:, 2] < np.pi)).all()
    back = complex_places(origin) + np.exp(1j * origin[:, 2]) * complex_places(way)
    np.testing.assert_allclose(back, complex_places(poses), atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * (origin[:, 2] + way[:, 2])), np.exp(1j * poses[:, 2]), atol=1e-12)


def test_who_has_not_moved_has_come_nowhere() -> None:
    poses = random_poses(1, (3, 4))
    assert not relative_poses(poses, poses, np.ones((3, 4), dtype=bool)).any()


def dense(packed: PackedMaps, config: MapConfig, patch: int) -> np.ndarray:
    """Maps (M, H, W) of packed ones."""
    columns = config.size // patch
    maps = np.zeros((len(packed.counts), config.size, config.size), dtype=np.uint8)
    owners = np.repeat(np.arange(len(packed.counts)), packed.counts)
    for owner, place, cells in zip(owners, packed.positions, packed.patches, strict=True):
        row, column = patch * (place // columns), patch * (place % columns)
        maps[owner, row : row + patch, column : column + patch] = cells.reshape(patch, patch)
    return maps


def maps_of(view: View, *, shifted: bool) -> np.ndarray:
    assert view.odometry is not None
    config = MapConfig()
    packer = ScanPacker(view.scans.config, config, 10)
    moved = view.odometry.reshape(-1, 3) if shifted else None
    return dense(packer.pack(view.scans.ranges.reshape(-1, view.scans.config.rays), moved), config, 10)


def within_a_cell(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether occupied cells of each map have an occupied one of the other at most a cell away.

    Up to 4 % need not: a robot that has moved sees a little of faces that grazed its rays before, and none of others.
    """
    square = np.ones((3, 3), dtype=bool)
    wide = [ndimage.binary_dilation(each, square) for each in (one, other)]
    misfits = (one.astype(bool) & ~wide[1]).sum() + (other.astype(bool) & ~wide[0]).sum()
    return bool(misfits <= 0.04 * (one.sum() + other.sum()))


def around(seed: int) -> np.ndarray:
    """A robot that looks and four others, in sight and not in front of each other, shape (1, 5, 3)."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-np.pi, np.pi) + np.arange(4) * np.pi / 2 + rng.uniform(-0.3, 0.3, 4)
    radii = rng.uniform(0.7, 1.6, 4)
    places = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    return np.concatenate([np.vstack([[0, 0], places]), rng.uniform(-np.pi, np.pi, (5, 1))], axis=1)[None]


@settings(deadline=None, max_examples=15)
@given(seeds, st.sampled_from([0.1, 0.15, 0.2, 0.3]), st.sampled_from([0.0, 0.8, -1.5]))
def test_an_old_scan_is_drawn_where_the_robot_is_now(seed: int, latency: float, rate: float) -> None:
    poses = around(seed)
    world = World(poses, replace(ROUND, latency=latency))
    direction = np.random.default_rng(seed).uniform(-np.pi, np.pi)
    commands = np.zeros((1, 5, 3))
    commands[0, 0] = 0.25 * np.cos(direction), 0.25 * np.sin(direction), rate
    for _ in range(6):
        world.apply(commands, 0.1)
    view = world.observe()
    assert view.odometry is not None
    then = integrate(poses, commands, 0.6 - 0.1 * np.ceil(latency / 0.1 - 1e-6))
    np.testing.assert_allclose(view.odometry[0], relative_poses(world.poses[0], then[0], np.ones(5, bool)), atol=1e-9)
    fresh = World(world.poses, ROUND).observe()
    shifted = maps_of(view, shifted=True)[0]
    assert shifted.any()
    assert within_a_cell(shifted, maps_of(fresh, shifted=False)[0])
    # The others stand still, and so do the maps that they make.
    np.testing.assert_array_equal(maps_of(view, shifted=True)[1:], maps_of(view, shifted=False)[1:])
    if abs(rate) > 1.0 and latency > 0.15:
        assert not within_a_cell(maps_of(view, shifted=False)[0], maps_of(fresh, shifted=False)[0])


@pytest.mark.parametrize("latency", [0.0, 0.25])
def test_at_rest_maps_keep_every_bit(latency: float) -> None:
    world = World(around(3), replace(ROUND, latency=latency))
    for _ in range(5):
        world.apply(np.zeros((1, 5, 3)), 0.1)
        view = world.observe()
        assert view.odometry is not None
        assert not view.odometry.any()
        np.testing.assert_array_equal(maps_of(view, shifted=True), maps_of(view, shifted=False))
    assert maps_of(view, shifted=True).any(axis=(1, 2)).all()


@pytest.mark.parametrize("rate", [0.0, 1.0])
def test_a_rolling_scan_shows_the_middle_of_its_turn(rate: float) -> None:
    rolling: Profile = replace(IDEAL, lidar=replace(IDEAL.lidar, rolling=True, period=0.2), latency=0.1)
    poses = random_poses(2, (2, 3))
    commands = np.random.default_rng(3).normal(0, 0.1, (2, 3, 3))
    commands[..., 2] = rate
    world = World(poses, rolling)
    for _ in range(7):
        world.apply(commands, 0.1)
    # At 0.7 s the newest scan that is ready was finished at 0.6 s and shows the turn from 0.4 s on.
    moved = world.observe().odometry
    begin, end = (integrate(poses, commands, time) for time in (0.4, 0.6))
    middle = (begin + end) / 2
    middle[..., 2] = begin[..., 2] + rate * 0.1
    np.testing.assert_allclose(moved, relative_poses(world.poses, middle, np.ones((2, 3), bool)), atol=1e-9)
    exact = relative_poses(world.poses, integrate(poses, commands, 0.5), np.ones((2, 3), bool))
    # A chord's middle lies this far from its arc.
    np.testing.assert_allclose(moved, exact, atol=3e-3)


def test_until_a_scan_is_ready_the_way_is_counted_from_the_start() -> None:
    poses, commands = random_poses(4, (1, 2)), np.full((1, 2, 3), 0.1)
    world = World(poses, replace(IDEAL, latency=1.0))
    world.apply(commands, 0.5)
    view = world.observe()
    assert np.isinf(view.scans.ranges).all()
    np.testing.assert_allclose(view.odometry, relative_poses(world.poses, poses, view.active), atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(seeds, st.sampled_from([math.inf, 0.5, 2.0]), st.sampled_from([0.0, 0.05, 0.2]), st.booleans())
def test_robots_that_are_told_to_stop_come_to_rest_where_they_should(
    seed: int, acceleration: float, lag: float, turning: bool
) -> None:
    """Against the drive itself, in small steps, straight on or on the spot."""
    rng = np.random.default_rng(seed)
    drive = Drive(max_acceleration=acceleration, max_turn_acceleration=3 * acceleration, lag=lag)
    pose = random_poses(seed, (1,))
    velocity = rng.uniform(-0.5, 0.5, (1, 3)) * ([0, 0, 1] if turning else [1, 1, 0])
    expected, step = resting_poses(pose, velocity, drive), 1e-3
    for _ in range(3000):
        pose, velocity = steer(pose, velocity, np.zeros((1, 3)), drive, step)
    np.testing.assert_allclose(np.abs(velocity), 0.0, atol=1e-3)
    np.testing.assert_allclose(pose[:, :2], expected[:, :2], atol=2e-3)
    assert np.abs(np.exp(1j * pose[:, 2]) - np.exp(1j * expected[:, 2])).max() < 2e-3


def test_robots_that_stop_at_once_rest_where_they_are() -> None:
    poses = random_poses(0, (3, 4))
    np.testing.assert_array_equal(resting_poses(poses, random_poses(1, (3, 4)), Drive()), poses)


@pytest.mark.parametrize("slow", [{"lag": 0.15}, {"max_acceleration": 1.5}])
def test_a_team_whose_wheels_do_not_stop_at_once_settles(slow: dict[str, float]) -> None:
    """Steered from where robots are now, instead of where they would rest, these teams swing for ever."""
    world = World(
        sample_starts(9, 4, 3), replace(IDEAL.seeing(3.0), drive=replace(IDEAL.drive, **slow)), seeds=range(4)
    )
    drive_team(world, make_controller("policy"), 30.0)
    assert np.median(np.linalg.norm(world.velocities[..., :2], axis=-1)) < 0.005
