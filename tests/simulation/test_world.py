"""The batched world: timing of scans, determinism, robots that come and go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from triform.simulation import (
    HARDWARE,
    IDEAL,
    ROBOMASTER_EP,
    Arena,
    Profile,
    World,
    cast_rolling,
    cast_scans,
    get_arena,
    get_profile,
    integrate,
    sample_starts,
)
from triform.simulation import (
    lidar as lidar_module,
)
from triform.simulation import (
    world as world_module,
)
from triform.threads import limit_threads, usable_threads
from triform.types import ConfigurationError, ScanConfig, TriformError

Array = NDArray[np.float64]
NOISY = replace(HARDWARE, lidar=replace(HARDWARE.lidar, angle_noise=0.005))
NOISY_INSTANT = replace(NOISY, lidar=replace(NOISY.lidar, rolling=False))
#: A rolling LiDAR without errors on a base without limits.
ROLLING = replace(IDEAL, lidar=replace(IDEAL.lidar, rolling=True, period=0.25))


def _commands(worlds: int, robots: int, seed: int = 0) -> Array:
    """Slow random twists; world b's do not depend on the others."""
    return np.stack([np.random.default_rng([seed, b]).normal(0, 0.1, (robots, 3)) for b in range(worlds)])


def _history(world: World, commands: Array, ticks: int = 8) -> list[Array]:
    """Everything that can be seen of a run, world by world along axis 0."""
    seen = []
    for _ in range(ticks):
        view = world.observe()
        seen += [view.poses, view.scans.ranges, world.velocities, view.noise, view.odometry]
        world.apply(commands, world.control_period)
    return [*seen, world.min_distance, world.collided, world.hit_arena]


@pytest.fixture
def all_threads(monkeypatch: pytest.MonkeyPatch) -> int:
    """Let even small work use every thread; return how many there are."""
    for module in (world_module, lidar_module):
        monkeypatch.setattr(module, "MOVING_RAYS_PER_THREAD", 1)
    monkeypatch.setattr(lidar_module, "RAYS_PER_THREAD", 1)
    monkeypatch.setattr(world_module, "RECORDS_PER_THREAD", 1)
    return usable_threads()


@pytest.mark.parametrize(
    "profile",
    [IDEAL, NOISY, NOISY_INSTANT, get_profile("turtlebot4")],
    ids=["ideal", "rolling", "instant", "differential"],
)
def test_runs_do_not_depend_on_threads_or_batch(profile: Profile, all_threads: int) -> None:
    poses, commands = sample_starts(5, 6, 11), _commands(6, 5)
    arena = get_arena("pillars")
    reference = None
    for threads in range(1, all_threads + 1):
        with limit_threads(threads):
            history = _history(World(poses, profile, arena, seeds=range(6)), commands)
        reference = reference or history
        for first, second in zip(reference, history, strict=True):
            np.testing.assert_array_equal(first, second)
    assert reference is not None
    for b in (0, 4):
        alone = _history(World(poses[b : b + 1], profile, arena, seeds=[b]), commands[b : b + 1])
        for first, second in zip(reference, alone, strict=True):
            np.testing.assert_array_equal(first[b : b + 1], second)


def test_a_world_does_not_notice_robots_joining_another() -> None:
    poses = sample_starts(4, 2, 3)
    both = World(poses, NOISY, seeds=[5, 6])
    alone = World(poses[:1], NOISY, seeds=[5])
    both.apply(_commands(2, 4), 0.2)
    alone.apply(_commands(1, 4), 0.2)
    both.add_robot(1, [3.0, 3.0, 0.0])
    assert both.poses.shape == (2, 5, 3)
    for _ in range(4):
        commands = np.pad(_commands(2, 4), ((0, 0), (0, 1), (0, 0)))
        both.apply(commands, 0.125)
        alone.apply(commands[:1, :4], 0.125)
        seen, own = both.observe(), alone.observe()
        np.testing.assert_array_equal(seen.scans.ranges[:1, :4], own.scans.ranges)
        np.testing.assert_array_equal(seen.noise[:1, :4], own.noise)
        np.testing.assert_array_equal(seen.odometry[:1, :4], own.odometry)
        np.testing.assert_array_equal(both.poses[:1, :4], alone.poses)


def test_seeds_matter_and_noise_differs_between_robots() -> None:
    poses = np.tile(np.array([[[0.0, 0, 0], [1.0, 0, np.pi]]]), (2, 1, 1))
    world = World(poses, NOISY_INSTANT, seeds=[1, 2])
    world.apply(np.zeros((2, 2, 3)), 0.3)
    ranges = world.observe().scans.ranges
    assert not np.array_equal(ranges[0], ranges[1], equal_nan=True)
    assert not np.array_equal(ranges[0, 0], ranges[0, 1], equal_nan=True)
    with pytest.raises(ConfigurationError, match="one seed for every world"):
        World(poses, NOISY)
    with pytest.raises(ConfigurationError, match="1 seeds given for 2 worlds"):
        World(poses, NOISY, seeds=[1])


def test_world_moves_as_kinematics_say() -> None:
    poses, commands = sample_starts(5, 3, 1), _commands(3, 5)
    world = World(poses, IDEAL)
    for duration in (0.1, 0.125, 0.003):
        world.apply(commands, duration)
    odometry = integrate(poses, commands, 0.228)
    np.testing.assert_allclose(world.poses, odometry, atol=1e-12)
    assert world.time == pytest.approx(0.228, abs=1e-12)
    np.testing.assert_array_equal(world.velocities, commands)


def test_instant_scans_come_at_multiples_of_the_period() -> None:
    poses, commands = sample_starts(4, 2, 9), _commands(2, 4)
    world = World(poses, IDEAL)
    active = np.ones((2, 4), dtype=bool)

    def expected(time: float) -> Array:
        scene = (ROBOMASTER_EP, Arena.open(), IDEAL.lidar.scan)
        return cast_scans(integrate(poses, commands, time), active, *scene, dtype=np.float32)

    np.testing.assert_array_equal(world.observe().scans.ranges, expected(0.0))
    for duration, newest in [(0.08, 0.0), (0.02, 0.1), (0.09, 0.1), (0.25, 0.4)]:
        world.apply(commands, duration)
        ranges, exact = world.observe().scans.ranges, expected(newest)
        finite = np.isfinite(exact)
        np.testing.assert_array_equal(np.isfinite(ranges), finite)
        np.testing.assert_allclose(ranges[finite], exact[finite], atol=1e-6)


def test_every_ray_of_a_rolling_turn_is_measured_at_its_own_time() -> None:
    poses, commands = sample_starts(4, 1, 10), _commands(1, 4)
    commands[..., 2] = 0.0
    commands[..., :2] *= 2
    world = World(poses, ROLLING)
    for duration in (0.1, 0.1, 0.02, 0.2, 0.1):
        world.apply(commands, duration)
    ranges = world.observe().scans.ranges
    begin, end = (integrate(poses, commands, time) for time in (0.25, 0.5))
    # Without turning, robots run straight, so that interpolating a whole turn is exact too.
    exact = cast_rolling(begin, end, np.ones((1, 4), dtype=bool), ROBOMASTER_EP, Arena.open(), ROLLING.lidar.scan)
    finite = np.isfinite(exact)
    assert finite.sum() > 50
    np.testing.assert_array_equal(np.isfinite(ranges), finite)
    np.testing.assert_allclose(ranges[finite], exact[finite], atol=1e-6)


def test_a_robot_turning_at_the_rate_of_its_lidar_sees_one_direction() -> None:
    profile = replace(ROLLING, lidar=replace(ROLLING.lidar, scan=ScanConfig(range_max=5.0), period=0.5))
    wall = Arena("wall", np.array([[-2.0, -9.0, -2.0, 9.0]]))
    world = World(np.zeros((1, 1, 3)), profile, wall)
    world.apply(np.array([[[0.0, 0.0, -4 * np.pi]]]), 0.5)
    np.testing.assert_allclose(world.observe().scans.ranges, 2.0, atol=1e-3)


def test_latency_holds_scans_back() -> None:
    world = World(sample_starts(3, 1, 2), replace(ROLLING, latency=0.12))
    still = np.zeros((1, 3, 3))
    exact = cast_scans(world.poses, world.active, ROBOMASTER_EP, Arena.open(), ROLLING.lidar.scan)
    world.apply(still, 0.36)
    assert np.all(world.observe().scans.ranges == np.inf)
    world.apply(still, 0.01)
    np.testing.assert_allclose(world.observe().scans.ranges, exact, atol=1e-6)


def test_turns_finish_however_the_time_is_cut() -> None:
    poses, commands = sample_starts(3, 1, 4), _commands(1, 3)
    ranges = []
    for parts in (1, 3, 7, 90):
        world = World(poses, ROLLING)
        for _ in range(parts):
            world.apply(commands, 0.9 / parts)
        ranges.append(world.observe().scans.ranges)
        finite = np.isfinite(ranges[0])
        np.testing.assert_array_equal(np.isfinite(ranges[-1]), finite)
        # Poses between steps are interpolated on chords of arcs.
        np.testing.assert_allclose(ranges[-1][finite], ranges[0][finite], atol=1e-5)


def test_robots_join_and_leave() -> None:
    poses = np.array([[[0.0, 0, 0], [1.0, 0, np.pi]], [[0.0, 0, 0], [1.0, 0, np.pi]]])
    world = World(poses, IDEAL)
    early = world.observe()
    assert world.add_robot(0, [0.0, 1.0, 0.0]) == 2
    np.testing.assert_array_equal(world.active, [[True, True, True], [True, True, False]])
    assert np.isnan(world.poses[1, 2]).all()
    assert np.all(world.observe().scans.ranges[:, 2] == np.inf)
    world.apply(np.zeros((2, 3, 3)), 0.1)
    ranges = world.observe().scans.ranges
    assert np.isfinite(ranges[0, 2]).any()
    left = round((np.pi + np.pi / 2) / IDEAL.lidar.scan.angle_increment)
    assert np.isfinite(ranges[0, 0, left])
    assert ranges[1, 0, left] == np.inf
    world.remove_robot(0, 1)
    assert np.all(world.observe().scans.ranges[0, 1] == np.inf)
    world.apply(np.ones((2, 3, 3)), 0.1)
    assert np.isnan(world.poses[0, 1]).all()
    assert not world.velocities[0, 1].any()
    assert world.observe().scans.ranges[0, 0, 225] == np.inf
    assert world.add_robot(0, [2.0, 2.0, 0.0]) == 1
    assert world.add_robot(1, [2.0, 2.0, 0.0]) == 2
    # A view that was handed out does not change.
    assert early.poses.shape == (2, 2, 3)
    assert np.isfinite(early.scans.ranges[:, :, 225]).all()
    with pytest.raises(TriformError, match="world 0 has no robot 7; its robots are"):
        world.remove_robot(0, 7)
    with pytest.raises(TriformError, match="no world 2"):
        world.add_robot(2, [0.0, 0.0, 0.0])
    with pytest.raises(TriformError, match="three finite numbers"):
        world.add_robot(0, [0.0, np.nan, 0.0])


def test_pushes_and_odometry_follow_robots_that_come_and_go() -> None:
    world = World(sample_starts(3, 2, 8), replace(ROLLING, latency=0.3), seeds=[1, 2])
    reference = World(sample_starts(3, 1, 8), replace(ROLLING, latency=0.3), seeds=[1])
    commands = np.zeros((2, 3, 3))
    commands[..., 0] = 0.2
    for tick in range(12):
        if tick == 3:
            assert world.add_robot(0, [4.0, 4.0, 0.5]) == 3
            commands = np.pad(commands, ((0, 0), (0, 1), (0, 0)))
        if tick == 6:
            world.remove_robot(0, 1)
        if tick == 9:
            assert world.add_robot(0, [-4.0, 4.0, 0.5]) == 1
        view = world.observe()
        shape = (2, 4 if tick >= 3 else 3)
        assert view.noise.shape == (*shape, 2)
        assert view.odometry.shape == (*shape, 3)
        assert np.isfinite(view.odometry).all()
        assert not view.odometry[~view.active].any()
        # Who is new stands where its first scan will say, and what a robot draws does not hang on the others.
        if tick in (3, 9):
            assert not view.odometry[0, 3 if tick == 3 else 1].any()
        np.testing.assert_array_equal(view.noise[0, :3], reference.observe().noise[0])
        world.apply(commands, 0.1)
        reference.apply(np.zeros((1, 3, 3)), 0.1)
    assert world.observe().odometry[0, 0, 0] > 0.0
    assert len(np.unique([view.noise[0, 0, 0], view.noise[0, 3, 0], view.noise[1, 0, 0]])) == 3


def test_pushes_change_every_half_second() -> None:
    world = World(sample_starts(2, 1, 1), IDEAL, seeds=[4])
    drawn = []
    for _ in range(15):
        drawn.append(world.observe().noise[0, 0, 0])
        world.apply(np.zeros((1, 2, 3)), 0.1)
    assert len(set(drawn)) == 3
    assert drawn == sorted(drawn, key=drawn.index)
    assert [drawn.count(each) for each in dict.fromkeys(drawn)] == [5, 5, 5]


def test_a_view_refuses_pushes_and_odometry_of_another_shape() -> None:
    view = World(sample_starts(2, 1, 1), IDEAL).observe()
    for name, width in (("noise", 2), ("odometry", 3)):
        for shape in ((1, 2, width + 1), (1, 3, width), (2, width)):
            with pytest.raises(ConfigurationError, match=f"a view has {name} of shape"):
                replace(view, **{name: np.zeros(shape)})
        assert getattr(replace(view, **{name: None}), name) is None


def test_who_joins_during_a_turn_has_no_past() -> None:
    world = World(np.zeros((1, 1, 3)), replace(NOISY, lidar=replace(NOISY.lidar, dropout=0.0)), seeds=[1])
    world.apply(np.zeros((1, 1, 3)), 0.1)
    robot = world.add_robot(0, [1.0, 0.0, 0.0])
    world.apply(np.zeros((1, 2, 3)), 0.2)
    ranges = world.observe().scans.ranges[0, robot]
    past = int(np.ceil(0.1 * 6 * 667))
    assert np.isnan(ranges[:past]).all()
    assert not np.isnan(ranges[past:]).any()
    world.apply(np.zeros((1, 2, 3)), 0.2)
    assert not np.isnan(world.observe().scans.ranges).any()


def test_a_leaver_is_gone_from_scans_under_way() -> None:
    world = World(sample_starts(3, 1, 1), NOISY, seeds=[1])
    world.apply(np.zeros((1, 3, 3)), 0.25)
    world.remove_robot(0, 1)
    for _ in range(3):
        world.apply(np.zeros((1, 3, 3)), 0.125)
        assert np.all(world.observe().scans.ranges[0, 1] == np.inf)


def test_bad_commands_and_durations_are_refused() -> None:
    world = World(sample_starts(2, 2, 1), IDEAL)
    commands = np.zeros((2, 2, 3))
    for value in (np.nan, np.inf):
        commands[1, 0, 2] = value
        with pytest.raises(TriformError, match="robot 0 in world 1 is not finite"):
            world.apply(commands, 0.1)
    with pytest.raises(TriformError, match=r"\(2, 2, 3\) is needed"):
        world.apply(np.zeros((2, 3, 3)), 0.1)
    for duration in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(TriformError, match="cannot be held"):
            world.apply(np.zeros((2, 2, 3)), duration)
    assert world.time == 0.0


def test_bad_placements_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="at least one of each"):
        World(np.zeros((1, 0, 3)), IDEAL)
    with pytest.raises(ConfigurationError, match=r"\(worlds, robots, 3\) is needed"):
        World(np.zeros((2, 3)), IDEAL)
    poses = np.zeros((1, 2, 3))
    poses[0, 1, 0] = np.nan
    with pytest.raises(ConfigurationError, match="robot 1 in world 0"):
        World(poses, IDEAL)
    assert np.isnan(World(poses, IDEAL, active=np.array([[True, False]])).poses[0, 1]).all()
    with pytest.raises(ConfigurationError, match="true or false are needed"):
        World(np.zeros((1, 2, 3)), IDEAL, active=np.array([[1, 0]]))


def test_coincident_and_single_robots_are_defined() -> None:
    coincident = World(np.zeros((1, 2, 3)), IDEAL)
    assert np.all(coincident.observe().scans.ranges == -np.inf)
    assert coincident.collided[0]
    assert coincident.min_distance[0] == 0.0
    alone = World(np.zeros((1, 1, 3)), IDEAL)
    assert np.all(alone.observe().scans.ranges == np.inf)
    assert alone.min_distance[0] == np.inf


def test_a_moved_robot_is_as_one_that_left_and_joined_with_its_own_number() -> None:
    start = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 2.0], [1.0, 1.0, 3.0]]])
    moved, other = (World(start, IDEAL, seeds=[0]) for _ in range(2))
    for world in (moved, other):
        world.apply(np.full((1, 4, 3), 0.1), 0.25)
    place = np.array([7.0, -7.0, 1.0])
    moved.move_robot(0, 2, place)
    other.remove_robot(0, 2)
    assert other.add_robot(0, place) == 2
    for world in (moved, other):
        world.apply(np.full((1, 4, 3), 0.1), 0.25)
    np.testing.assert_array_equal(moved.poses, other.poses)
    np.testing.assert_array_equal(moved.observe().scans.ranges, other.observe().scans.ranges)
    moved.remove_robot(0, 0)
    moved.move_robot(0, 2, place)
    np.testing.assert_array_equal(moved.active[0], [False, True, True, True])
    for robot, pose in ((0, place), (9, place), (2, [0.0, np.nan, 0.0]), (2, [0.0, 0.0])):
        before = moved.poses
        with pytest.raises(TriformError):
            moved.move_robot(0, robot, pose)
        np.testing.assert_array_equal(moved.poses, before)
