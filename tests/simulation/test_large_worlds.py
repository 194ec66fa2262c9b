"""Large teams in the built-in world: cells and lists of pairs against looking at everybody."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from triform.geometry.cells import SMALL_TEAM
from triform.simulation import (
    HARDWARE,
    IDEAL,
    ROBOMASTER_EP,
    Arena,
    Footprint,
    Profile,
    World,
    cast_rolling,
    cast_scans,
    cast_world,
    get_arena,
    sample_starts,
)
from triform.simulation import lidar as lidar_module
from triform.simulation import world as world_module
from triform.simulation.lidar import scan_rays
from triform.simulation.ray_kernels import Scene
from triform.threads import limit_threads
from triform.types import ScanConfig

Array = NDArray[np.float64]
CONFIG = ScanConfig(rays=90)
FEW_RAYS = replace(IDEAL, lidar=replace(IDEAL.lidar, scan=CONFIG))
ROLLING = replace(HARDWARE, lidar=replace(HARDWARE.lidar, scan=CONFIG, noise=(), dropout=0.0))


def _crowd(seed: int, robots: int, side: float) -> tuple[Array, NDArray[np.bool_]]:
    rng = np.random.default_rng(seed)
    poses = rng.uniform([0, 0, -np.pi], [side, side, np.pi], (1, robots, 3))
    active = rng.random((1, robots)) < 0.9
    poses[~active] = np.nan
    return poses, active


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.integers(SMALL_TEAM + 1, 120), st.sampled_from([3.0, 15.0, 1e6]), st.booleans())
def test_casting_by_cells_sees_what_looking_at_everybody_sees(
    seed: int, robots: int, side: float, circle: bool
) -> None:
    poses, active = _crowd(seed, robots, side)
    footprint = Footprint.circle(0.3) if circle else ROBOMASTER_EP
    arena = get_arena("pillars") if seed % 2 else Arena.open()
    expected = np.empty((robots, CONFIG.rays))
    scene = (Scene(footprint.body, arena.walls, arena.pillars), scan_rays(CONFIG))
    cast_world(poses[0], active[0], *scene, np.empty((robots, 2)), expected)
    np.testing.assert_array_equal(cast_scans(poses, active, footprint, arena, CONFIG)[0], expected)
    single = cast_scans(poses, active, footprint, arena, CONFIG, dtype=np.float32)[0]
    assert single.dtype == np.float32
    np.testing.assert_array_equal(single, expected.astype(np.float32))
    # Ray by ray, from lists of those who are near.
    by_ray = cast_rolling(poses, poses, active, footprint, arena, CONFIG)[0]
    with np.errstate(invalid="ignore"):
        same = (by_ray == expected) | (np.abs(by_ray - expected) < 1e-7)
    assert same.all()


def test_who_moves_into_sight_during_a_turn_is_seen() -> None:
    """Two robots that start 9 m apart and swap places, among many others who stay."""
    rng = np.random.default_rng(0)
    start = np.concatenate([[[0.0, 0, 0], [9.0, 0.0, 0]], rng.uniform([0, 30, -3], [40, 60, 3], (60, 3))])[None]
    end = start.copy()
    end[0, :2, :2] = start[0, 1::-1, :2]
    pair = np.zeros((1, 62), dtype=bool)
    pair[0, :2] = True
    everybody = np.ones_like(pair)
    alone = cast_rolling(start, end, pair, ROBOMASTER_EP, Arena.open(), CONFIG)[0, :2]
    assert np.isfinite(alone).any()
    np.testing.assert_array_equal(
        cast_rolling(start, end, everybody, ROBOMASTER_EP, Arena.open(), CONFIG)[0, :2], alone
    )


@pytest.mark.parametrize("robots", [6, 60])
@pytest.mark.parametrize("footprint", [ROBOMASTER_EP, Footprint.circle(0.3)], ids=["box", "circle"])
def test_contacts_of_moving_robots_are_those_of_all_pairs_at_every_step(robots: int, footprint: Footprint) -> None:
    rng = np.random.default_rng(robots)
    side = 0.9 * np.sqrt(robots)
    profile = replace(IDEAL, footprint=footprint, lidar=replace(IDEAL.lidar, scan=ScanConfig(rays=1)))
    fine = replace(profile, control_period=profile.time_step)
    collisions = []
    for _ in range(12):
        poses = rng.uniform([0, 0, -3], [side, side, 3], (1, robots, 3))
        while np.min(np.linalg.norm(poses[0, :, None, :2] - poses[0, :, :2], axis=-1) + 9 * np.eye(robots)) < 0.36:
            poses = rng.uniform([0, 0, -3], [side, side, 3], (1, robots, 3))
            side *= 1.02
        world, watched = World(poses, profile), World(poses, fine)
        closest, overlapped = world.min_distance[0], world.collided[0]
        for _ in range(6):
            commands = rng.normal(0, 0.6, (1, robots, 3))
            world.apply(commands, 0.1)
            for _ in range(10):
                watched.apply(commands, 0.01)
                apart = np.linalg.norm(watched.poses[0, :, None, :2] - watched.poses[0, :, :2], axis=-1)
                closest = min(closest, apart[np.triu_indices(robots, 1)].min())
                overlapped |= World(watched.poses, profile).collided[0]
        assert world.min_distance[0] == pytest.approx(closest, abs=1e-12)
        assert world.collided[0] == overlapped
        collisions.append(overlapped)
    assert 0 < sum(collisions) < 12 or footprint.is_circle or robots > 6


@pytest.mark.parametrize("profile", [FEW_RAYS, ROLLING], ids=["instant", "rolling"])
def test_runs_of_large_teams_do_not_depend_on_threads_or_batch(
    profile: Profile, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module, name in (
        (lidar_module, "RAYS_PER_THREAD"),
        (lidar_module, "MOVING_RAYS_PER_THREAD"),
        (world_module, "MOVING_RAYS_PER_THREAD"),
        (world_module, "RECORDS_PER_THREAD"),
    ):
        monkeypatch.setattr(module, name, 1)
    poses = sample_starts(200, 2, 5)
    commands = np.random.default_rng(0).normal(0, 0.2, poses.shape)

    def history(first: int, last: int, threads: int) -> list[Array]:
        seen = []
        with limit_threads(threads):
            world = World(poses[first:last], profile, seeds=range(first, last))
            for _ in range(5):
                world.apply(commands[first:last], world.control_period)
                view = world.observe()
                seen += [view.poses, view.scans.ranges]
        return [*seen, world.min_distance, world.collided]

    together = history(0, 2, 1)
    for first, second in zip(together, history(0, 2, 3), strict=True):
        np.testing.assert_array_equal(first, second)
    for b in range(2):
        for first, second in zip(together, history(b, b + 1, 3), strict=True):
            np.testing.assert_array_equal(first[b : b + 1], second)


def test_scans_are_kept_in_single_precision_and_not_twice() -> None:
    world = World(sample_starts(50, 1, 1), IDEAL)
    ranges = world.observe().scans.ranges
    assert ranges.dtype == np.float32
    assert world.observe().scans.ranges is ranges
    waiting = World(sample_starts(50, 1, 1), HARDWARE, seeds=[1]).observe().scans.ranges
    assert waiting.shape == (1, 50, 667)
    assert (waiting == np.inf).all()
    # One number stands for all the rays that have not been measured.
    assert waiting.strides == (0, 0, 0)
