from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely.geometry import Point, box

from tests.fuzz import mujoco_worlds
from tests.options import options
from tests.simulators.bases import on_base
from triform.cli import main
from triform.control import drive, make_controller
from triform.evaluation.events import Event
from triform.evaluation.scenario import Scenario
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.simulation import (
    HARDWARE,
    IDEAL,
    Arena,
    Footprint,
    Mounting,
    World,
    get_arena,
    integrate,
    sample_starts,
    steer,
)
from triform.simulation.intensity import Brightness
from triform.simulators.chassis import BASES, MAX_ACCELERATION, MAX_TURN_ACCELERATION, braked
from triform.simulators.mujoco import MujocoError, MujocoTeam
from triform.simulators.mujoco.model import write_model
from triform.threads import limit_threads
from triform.types import ConfigurationError, ScanConfig, TriformError

WORLDS, ROBOTS = 2, 5
STARTS = sample_starts(ROBOTS, WORLDS, 3)
SEEDS = [np.random.SeedSequence(5), np.random.SeedSequence(6)]
each_base = pytest.mark.parametrize("base", BASES)


def close(first, second, tolerance=1e-5):
    with np.errstate(invalid="ignore"):
        same = (first == second) | (np.isnan(first) & np.isnan(second)) | (np.abs(first - second) <= tolerance)
    return bool(same.all())


def alone(pose=(0.0, 0.0, 0.0), profile=IDEAL, base="planar", arena=None):
    return MujocoTeam([[pose]], on_base(profile, base), arena, base=base)


@each_base
def test_a_first_view_is_that_of_the_built_in_world(base):
    profile = on_base(IDEAL, base)
    seen = MujocoTeam(STARTS, profile, seeds=SEEDS, base=base).observe()
    expected = World(STARTS, profile, seeds=SEEDS).observe()
    assert close(seen.scans.ranges, expected.scans.ranges)
    np.testing.assert_allclose(seen.poses, expected.poses, atol=1e-9)
    np.testing.assert_allclose(seen.noise, expected.noise, atol=1e-12)
    np.testing.assert_allclose(seen.odometry, 0.0, atol=1e-9)
    assert seen.active.all()
    assert seen.time == 0.0


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_scans_are_those_of_the_built_in_lidar(seed):
    assert mujoco_worlds.scans(np.random.default_rng(seed)) == ""


@given(
    radius=st.floats(0.02, 0.5),
    bearing=st.floats(-np.pi, np.pi),
    heading=st.floats(-np.pi, np.pi),
    overlap=st.floats(0.001, 0.02),
)
def test_contacts_with_a_pillar_are_as_deep_as_the_outlines_overlap(radius, bearing, heading, overlap):
    import mujoco

    model = mujoco.MjModel.from_xml_string(
        write_model(IDEAL, Arena("pillar", np.empty((0, 4)), np.array([[0.0, 0.0, radius]])), 1, "planar")
    )
    data = mujoco.MjData(model)
    half_length, half_width = IDEAL.footprint.half_length, IDEAL.footprint.half_width
    towards = np.array([np.cos(bearing - heading), np.sin(bearing - heading)])
    outline = box(-half_length, -half_width, half_length, half_width)
    # The pillar's centre at a distance from the outline, in the robot's frame, by bisection.
    near, far = 0.0, 2.0
    for _ in range(60):
        middle = (near + far) / 2
        near, far = (near, middle) if outline.distance(Point(middle * towards)) > radius - overlap else (middle, far)
    away = np.array([np.cos(bearing), np.sin(bearing)])
    data.qpos[:3] = [*(-far * away), heading]
    mujoco.mj_forward(model, data)
    assume(overlap < 0.9 * radius)
    assert max(-contact.dist for contact in data.contact) == pytest.approx(overlap, abs=1e-4)


@pytest.mark.parametrize("seed", [*range(4), 262143])
def test_robots_that_push_each_other_are_solid_and_the_same_to_the_bit(seed):
    assert mujoco_worlds.runs(np.random.default_rng(seed)) == ""


def test_what_is_nearer_than_range_min_is_too_near():
    profile = replace(IDEAL, lidar=replace(IDEAL.lidar, scan=ScanConfig(rays=4, range_min=0.5, range_max=1.0)))
    arena = Arena(walls=np.array([[-3.0, 0.4, 3.0, 0.4], [-3.0, -0.7, 3.0, -0.7]]))
    ranges = alone(profile=profile, arena=arena).observe().scans.ranges
    # Backwards, right, forwards, left.
    np.testing.assert_allclose(ranges[0, 0], [np.inf, 0.7, np.inf, -np.inf], atol=1e-3)


@pytest.mark.parametrize(
    ("angle_noise", "mounting"), [(0.0, Mounting()), (0.02, Mounting(x=0.05, y=-0.03, blind_sectors=((30.0, 50.0),)))]
)
@each_base
def test_rolling_turns_errors_and_latency_are_those_of_the_built_in_world(base, angle_noise, mounting):
    """Robots at rest measure the same, so every error that is drawn must fall on the same ray."""
    lidar = replace(HARDWARE.lidar, angle_noise=angle_noise)
    profile = on_base(replace(HARDWARE, lidar=lidar, mounting=mounting), base)
    still = np.zeros((WORLDS, ROBOTS, 3))
    team, world = MujocoTeam(STARTS, profile, seeds=SEEDS, base=base), World(STARTS, profile, seeds=SEEDS)
    for _ in range(6):
        for body in (team, world):
            body.apply(still, profile.control_period)
        seen, expected = team.observe(), world.observe()
        # Wheels sink in by a fraction of a millimetre, which turns a robot by less than that over its length.
        assert close(seen.scans.ranges, expected.scans.ranges, 1e-5 if base == "planar" else 1e-3)
        assert seen.time == expected.time
    assert np.isnan(expected.scans.ranges).any()


def test_rays_of_a_rolling_turn_are_measured_on_the_way():
    """Robots that turn by 14 degrees per turn of their LiDAR: what is measured too early or late is rays away."""
    lidar = replace(HARDWARE.lidar, noise=(), dropout=0.0)
    turning = replace(HARDWARE, lidar=lidar, drive=replace(HARDWARE.drive, max_turn_acceleration=10.0))
    commands = np.tile([0.05, 0.05, 1.5], (1, ROBOTS, 1)) * np.array([1, -1, 1, -1, 1])[None, :, None]
    team, world = MujocoTeam(STARTS[:1], turning, seeds=SEEDS[:1]), World(STARTS[:1], turning, seeds=SEEDS[:1])
    same = {shift: [] for shift in (-5, 0, 5)}
    for _ in range(10):
        for body in (team, world):
            body.apply(commands, turning.control_period)
        seen, expected = (np.isfinite(body.observe().scans.ranges) for body in (team, world))
        for shift, shares in same.items():
            shares.append((np.roll(seen, shift, axis=-1) == expected).mean())
    assert expected.mean() > 0.02
    assert np.mean(same[0]) > 0.99
    assert np.mean(same[0]) > max(np.mean(same[-5]), np.mean(same[5])) + 0.005


@pytest.mark.parametrize("lag", [0.0, 0.1])
def test_the_planar_base_moves_as_the_built_in_world(lag):
    commands = np.array([[[0.3, 0.2, 0.5], [-0.2, 0.1, -1.0], [0.0, 0.0, 2.0]]])
    limits = braked(replace(IDEAL.drive, lag=lag))
    poses, twists = np.array([[[0.0, 0.0, 0.3], [1.5, 0.2, 1.0], [-1.5, 0.5, 2.0]]]), np.zeros((1, 3, 3))
    team = MujocoTeam(poses, replace(IDEAL, drive=limits))
    for k in range(20):
        turned = commands * (1 if k < 12 else -0.5)
        team.apply(turned, 0.1)
        for _ in range(10):
            poses, twists = steer(poses, twists, turned, limits, 0.01)
        np.testing.assert_allclose(team.velocities, twists, atol=1e-6)
        np.testing.assert_allclose(team.poses[..., :2], poses[..., :2], atol=5e-3)
        np.testing.assert_allclose(np.angle(np.exp(1j * (team.poses - poses)[..., 2])), 0, atol=0.02)
    assert team.time == pytest.approx(2.0)


@pytest.mark.parametrize("base", ["planar", "mecanum"])
def test_commands_are_limited_as_in_the_built_in_world(base):
    team = alone(profile=replace(HARDWARE, lidar=IDEAL.lidar), base=base)
    team.apply(np.array([[[3.0, 0.05, 0.0]]]), 2.0)
    np.testing.assert_allclose(team.velocities[0, 0], [0.1, 0.0083, 0.0], atol=5e-4 if base == "planar" else 5e-3)


@each_base
def test_robots_move_like_those_of_the_built_in_world(base):
    robots = on_base(IDEAL, base)
    limited = replace(robots, drive=braked(robots.drive))
    controller = make_controller("triangulating")
    duration, tolerance = (1.5, 0.1) if base == "mecanum" else (3.0, 0.05)
    team, world = MujocoTeam(STARTS[:1], limited, base=base), World(STARTS[:1], limited)
    drive(team, controller, duration)
    drive(world, controller, duration)
    assert not team.collided.any()
    np.testing.assert_allclose(team.poses, world.poses, atol=tolerance)
    np.testing.assert_allclose(team.min_distance, world.min_distance, atol=0.03)


@pytest.mark.parametrize("command", [(0.3, 0.3, 0.5), (-0.2, 0.1, 0.3), (0.02, 0.0, 0.0), (0.0, -0.05, 0.1)])
def test_mecanum_wheels_reach_the_command(command):
    team = alone((1.0, -2.0, 0.7), base="mecanum")
    commands = np.array([[command]])
    team.apply(commands, 0.5)
    start, reached = team.poses, []
    for _ in range(100):
        team.apply(commands, 0.01)
        reached.append(team.velocities[0, 0])
    mean = np.mean(reached, axis=0)
    np.testing.assert_allclose(mean, command, atol=0.003 + 0.02 * np.linalg.norm(command))
    expected = integrate(start, commands, 1.0)
    np.testing.assert_allclose(team.poses[0, 0, :2], expected[0, 0, :2], atol=0.003 + 0.02 * np.linalg.norm(command))


@pytest.mark.parametrize("heading", [0.0, 0.9, -2.5])
def test_mecanum_wheels_stand_where_they_were_stopped(heading):
    team = alone((0.0, 0.0, heading), base="mecanum")
    team.apply(np.array([[[0.13, -0.07, 0.4]]]), 0.73)
    still = np.zeros((1, 1, 3))
    team.apply(still, 0.5)
    rest = team.poses
    team.apply(still, 2.0)
    # Less than 0.5 mm/s and 0.1 degrees per second.
    assert np.linalg.norm((team.poses - rest)[0, 0, :2]) < 1e-3
    assert abs((team.poses - rest)[0, 0, 2]) < 3.5e-3


def test_moments_between_two_steps_of_the_physics_do_not_add_up():
    team = MujocoTeam(STARTS, HARDWARE, seeds=SEEDS)
    for _ in range(80):
        team.apply(np.tile([0.1, 0.0, 0.0], (WORLDS, ROBOTS, 1)), 1 / 8)
    way = np.linalg.norm(team.poses[..., :2] - STARTS[..., :2], axis=-1)
    assert not team.collided.any()
    # The lag and the limit of acceleration cost the speed of about 0.1 s.
    np.testing.assert_allclose(way, 0.1 * (10.0 - 0.1), atol=0.01)


@each_base
def test_bodies_are_solid_and_contacts_are_seen_at_every_step(base):
    # Two robots of one world, three of another, of which one is before a wall.
    room = Arena(walls=np.array([[-2.0, 1.0, 2.0, 1.0]]))
    poses = np.array([[[0.0, 0.0, 0.0], [0.7, 0.0, 0.0]], [[0.0, 0.0, 0.0], [1.2, 0.6, np.pi / 2]]])
    team = MujocoTeam(poses, on_base(IDEAL, base), room, base=base)
    commands = np.zeros((2, 2, 3))
    np.testing.assert_allclose(team.min_distance, [0.7, np.hypot(1.2, 0.6)])
    commands[0, 0, 0] = commands[1, 1, 0] = 0.5
    team.apply(commands, 0.5)
    assert not team.collided.any()
    # Into each other and away again: only a look at every step shows it.
    team.apply(commands, 0.7)
    team.apply(-commands, 1.0)
    assert team.collided.tolist() == [True, False]
    assert team.hit_arena.tolist() == [False, True]
    assert team.min_distance[0] == pytest.approx(0.32, abs=0.01)
    team.apply(commands, 3.0)
    assert team.poses[1, 1, 1] < 1.0 - 0.15
    # Who is pushed moves; who pushes does not drive into it.
    gap = team.poses[0, 1, 0] - team.poses[0, 0, 0]
    assert 0.31 < gap < 0.36
    assert np.isfinite(team.poses).all()


@each_base
def test_robots_come_and_go(base):
    start = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]] * 2)
    team = MujocoTeam(start, on_base(IDEAL, base), seeds=SEEDS, base=base)
    moving = np.tile([0.1, 0.0, 0.0], (2, 2, 1))
    team.apply(moving, 0.3)
    before, speed = team.poses, team.velocities
    assert team.add_robot(0, [0.0, 1.0, 0.5]) == 2
    # Nothing happened to the others.
    np.testing.assert_array_equal(team.poses[:, :2], before)
    np.testing.assert_array_equal(team.velocities[:, :2], speed)
    assert team.active.tolist() == [[True] * 3, [True, True, False]]
    np.testing.assert_allclose(team.poses[0, 2], [0.0, 1.0, 0.5], atol=1e-9)
    assert np.isnan(team.poses[1, 2]).all()
    assert (team.velocities[:, 2] == 0).all()
    team.apply(np.zeros((2, 3, 3)), 0.1)
    ranges = team.observe().scans.ranges
    left = round(450 * 3 / 4)
    assert ranges[0, 0, left] == pytest.approx(1.0, abs=0.2)
    assert np.isinf(ranges[1, 0, left])
    assert np.isinf(ranges[1, 2]).all()
    assert team.add_robot(1, [0.0, 1.0, 0.0]) == 2
    team.remove_robot(0, 2)
    assert np.isnan(team.poses[0, 2]).all()
    team.apply(np.full((2, 3, 3), 0.01), 0.1)
    ranges = team.observe().scans.ranges
    assert np.isinf(ranges[0, 2]).all()
    assert np.isinf(ranges[0, 0, left])
    assert ranges[1, 0, left] == pytest.approx(1.0, abs=0.2)
    assert team.add_robot(0, [0.0, -1.0, 0.5]) == 2
    assert not team.collided.any()
    np.testing.assert_allclose(team.min_distance, np.hypot(0.0, 1.0), atol=0.05)


@each_base
def test_a_world_is_the_same_to_the_bit_whatever_the_batch_and_the_threads(base):
    # Two of them run into each other, one into a wall.
    crash = np.array([[0.0, 0.0, 0.3], [0.6, 0.05, -2.9], [2.6, 1.0, 0.0], [-1.5, -1.0, 2.0]])
    commands = np.array([[0.5, 0.0, 0.1], [0.5, 0.1, 0.0], [0.5, 0.0, 0.3], [0.2, 0.3, -0.5]])
    room = get_arena("room-6")

    def run(poses, threads):
        with limit_threads(threads):
            team = MujocoTeam(poses, on_base(IDEAL, base), room, base=base)
            found = []
            for _ in range(8):
                team.apply(np.tile(commands, (len(poses), 1, 1)), 0.1)
                found.append((team.poses, team.velocities, team.observe().scans.ranges, team.min_distance))
        assert team.collided[0]
        assert team.hit_arena[0]
        return [b"".join(np.ascontiguousarray(values[0]).tobytes() for values in each) for each in found]

    first = run(crash[None], 1)
    assert run(crash[None], 1) == first
    assert run(np.stack([crash, crash + [0.1, 0.0, 0.0], crash - [0.0, 0.2, 0.1]]), 2) == first


def test_physics_that_becomes_unstable_ends_a_run_in_a_sentence():
    team = MujocoTeam(STARTS, IDEAL)
    team._batch.qvel[1, 0] = 1e12
    with pytest.raises(MujocoError, match="world 1 became unstable"):
        team.apply(np.zeros((WORLDS, ROBOTS, 3)), 0.1)


def test_wrong_use_is_refused_in_a_sentence():
    with pytest.raises(ConfigurationError, match="shape"):
        MujocoTeam(np.zeros((ROBOTS, 3)), IDEAL)
    with pytest.raises(ConfigurationError, match="finite"):
        MujocoTeam(np.full((1, ROBOTS, 3), np.nan), IDEAL)
    with pytest.raises(ConfigurationError, match="base is 'legs'"):
        MujocoTeam(STARTS, IDEAL, base="legs")  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="too small for mecanum wheels"):
        MujocoTeam(STARTS, replace(IDEAL, footprint=Footprint.circle(0.1)), base="mecanum")
    with pytest.raises(ConfigurationError, match="seed"):
        MujocoTeam(STARTS, HARDWARE)
    team = MujocoTeam(STARTS, IDEAL)
    with pytest.raises(TriformError, match="commands of shape"):
        team.apply(np.zeros((1, 2, 3)), 0.1)
    with pytest.raises(TriformError, match="of robot 0 in world 0 is not finite"):
        team.apply(np.full((WORLDS, ROBOTS, 3), np.inf), 0.1)
    with pytest.raises(TriformError, match="held for"):
        team.apply(np.zeros((WORLDS, ROBOTS, 3)), 0.0)
    for change in (
        lambda: team.add_robot(WORLDS, np.zeros(3)),
        lambda: team.remove_robot(-1, 0),
        lambda: team.picture(WORLDS),
    ):
        with pytest.raises(TriformError, match="there is no world"):
            change()
    with pytest.raises(TriformError, match="cannot be placed"):
        team.add_robot(0, [0.0, np.nan, 0.0])
    with pytest.raises(TriformError, match="no robot 9"):
        team.remove_robot(0, 9)


@each_base
def test_an_evaluation_is_the_same_each_time_and_forms_teams(base):
    runs, duration = (3, 12.0) if base == "planar" else (2, 6.0)
    profile = "turtlebot4" if base == "differential" else "ideal"
    given = {"profile": profile, "duration": duration, "simulator": "mujoco", "base": base, "threads": 2}
    config = options(EvaluateConfig, robots=(4,), runs=runs, **given)
    first, second = evaluate(config), evaluate(config)
    for name, column in first.runs.items():
        np.testing.assert_array_equal(column, second.runs[name])
    assert not first.runs["collision"].any()
    if base == "planar":
        assert first.runs["success"].all()
    # A run does not depend on those beside it.
    scenario, last = config.scenario, runs - 1
    poses = scenario.sample_starts(4, runs, config.seed)
    alone, _ = scenario.run(poses[last:], seed=config.seed, indices=[last])
    together, _ = scenario.run(poses, seed=config.seed)
    np.testing.assert_array_equal(alone.poses[0], together.poses[last])


@pytest.mark.parametrize("kind", ["join", "leave"])
def test_teams_change(kind):
    scenario = Scenario(duration=20.0, simulator="mujoco", event=Event(kind, 8.0))
    trajectory, table = scenario.run(scenario.sample_starts(4, 2, 7))
    assert trajectory.active[:, 0].sum(axis=1).tolist() == [4, 4]
    after = 5 if kind == "join" else 3
    assert trajectory.active[:, -1].sum(axis=1).tolist() == [after, after]
    assert table["robots"].tolist() == [after, after]
    assert table["success"].all()


def test_without_mujoco_there_is_one_sentence(monkeypatch, capsys):
    for name in [each for each in sys.modules if each.startswith("triform.simulators.mujoco")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert main(["evaluate", "--simulator", "mujoco", "--robots", "3", "--runs", "1", "--threads", "1"]) == 1
    assert "pip install 'triform[mujoco]'" in capsys.readouterr().err


def test_a_picture_shows_the_robots():
    code = (
        "import numpy as np; from triform.simulators.mujoco import MujocoTeam; from triform.simulation import IDEAL;"
        "picture = MujocoTeam([[[0.0, 0.0, 0.0], [1.0, 0.0, 1.0]]], IDEAL).picture(width=160, height=120);"
        "blue = (picture[..., 2] > picture[..., 0] + 40);"
        "print(picture.shape, picture.dtype, blue.mean() > 0.005, blue[:, :80].any(), blue[:, 80:].any())"
    )
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "MUJOCO_GL": "egl"}, check=False)
    if run.returncode:
        assert "TriformError: MuJoCo's renderer does not work here" in run.stderr
        pytest.skip("there is no OpenGL")
    assert run.stdout.split("\n")[0] == "(120, 160, 3) uint8 True True True"


def test_the_acceleration_of_robots_with_a_mass_has_a_limit():
    assert (IDEAL.drive.max_acceleration, IDEAL.drive.max_turn_acceleration) == (np.inf, np.inf)
    team = alone()
    team.apply(np.array([[[0.5, 0.0, 5.0]]]), 0.1)
    np.testing.assert_allclose(
        team.velocities[0, 0], [0.1 * MAX_ACCELERATION, 0.0, 0.1 * MAX_TURN_ACCELERATION], atol=1e-12
    )


@pytest.mark.parametrize("profile", [IDEAL, HARDWARE], ids=["ideal", "hardware"])
def test_intensities_are_those_of_the_built_in_world(profile):
    lidar = replace(profile.lidar, min_intensity=230.0, brightness=Brightness(noise=0.0, falloff=10.0), noise=())
    robot = replace(profile, lidar=replace(lidar, dropout=0.0, scan=replace(lidar.scan, range_min=0.1)))
    pillars = np.array([[0.0, 0.8, 0.15], [-0.9, 0.2, 0.2]])
    arena = Arena("three", np.array([[-2.0, -1.0, 2.0, -1.2]]), pillars, pillar_intensities=[50.0, np.nan])
    poses = np.array([[[0.0, 0.0, 0.3], [0.9, 0.1, 2.0], [-0.4, -0.7, -1.0]]])
    teams = [MujocoTeam(poses, robot, arena, [7]), World(poses, robot, arena, [7])]
    for team in teams:
        for _ in range(6):
            team.apply(np.zeros((1, 3, 3)), 0.125)
    found, expected = (team.observe().scans for team in teams)
    # Walls are 1 mm thick there, and rays at rims may miss.
    differs = ~(np.abs(found.intensities - expected.intensities) < 0.1)
    assert differs.mean() < 0.01
    assert len(np.unique(expected.intensities.round(-1))) > 5
