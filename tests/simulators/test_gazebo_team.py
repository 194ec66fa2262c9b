from __future__ import annotations

import os
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from tests.options import options
from triform.cli import main
from triform.control import drive, make_controller
from triform.evaluation.events import Event
from triform.evaluation.scenario import Scenario
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.simulation import HARDWARE, IDEAL, Arena, Mounting, World, sample_starts
from triform.simulators.chassis import MAX_ACCELERATION
from triform.simulators.gazebo import GazeboServer, GazeboTeam, Installation
from triform.types import ConfigurationError, TriformError

ROBOTS = 5
START = sample_starts(ROBOTS, 1, 3)
SEEDS = [np.random.SeedSequence(5)]
OPEN = Arena.open()


def close(first, second, tolerance=1e-5):
    with np.errstate(invalid="ignore"):
        same = (first == second) | (np.isnan(first) & np.isnan(second)) | (np.abs(first - second) <= tolerance)
    return bool(same.all())


def test_a_first_view_is_that_of_the_built_in_world(gazebo):
    with GazeboServer(IDEAL, OPEN, ROBOTS) as server:
        seen, expected = GazeboTeam(server, START, SEEDS).observe(), World(START, IDEAL, seeds=SEEDS).observe()
    assert close(seen.scans.ranges, expected.scans.ranges)
    np.testing.assert_allclose(seen.poses, expected.poses, atol=1e-9)
    np.testing.assert_array_equal(seen.noise, expected.noise)
    np.testing.assert_allclose(seen.odometry, 0.0, atol=1e-9)
    assert seen.active.all()
    assert seen.time == 0.0


def test_rolling_turns_errors_and_latency_are_those_of_the_built_in_world(gazebo):
    """Robots at rest measure the same, so every error that is drawn must fall on the same ray."""
    still = np.zeros((1, ROBOTS, 3))
    with GazeboServer(HARDWARE, OPEN, ROBOTS) as server:
        team, world = GazeboTeam(server, START, SEEDS), World(START, HARDWARE, seeds=SEEDS)
        for _ in range(9):
            for body in (team, world):
                body.apply(still, HARDWARE.control_period)
            seen, expected = team.observe(), world.observe()
            assert close(seen.scans.ranges, expected.scans.ranges)
            assert seen.time == expected.time
    assert np.isnan(expected.scans.ranges).any()


def test_rays_of_a_rolling_turn_are_measured_on_the_way(gazebo):
    """Robots that turn by 14 degrees per turn of their LiDAR: what is measured too early or late is rays away."""
    lidar = replace(HARDWARE.lidar, noise=(), dropout=0.0)
    turning = replace(HARDWARE, lidar=lidar, drive=replace(HARDWARE.drive, max_turn_acceleration=10.0))
    commands = np.tile([0.05, 0.05, 1.5], (1, ROBOTS, 1)) * np.array([1, -1, 1, -1, 1])[None, :, None]
    with GazeboServer(turning, OPEN, ROBOTS) as server:
        team, world = GazeboTeam(server, START, SEEDS), World(START, turning, seeds=SEEDS)
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


def test_robots_move_like_those_of_the_built_in_world(gazebo):
    limited = replace(IDEAL, drive=replace(IDEAL.drive, max_acceleration=MAX_ACCELERATION))
    controller = make_controller("triangulating")
    with GazeboServer(limited, OPEN, ROBOTS) as server:
        team, world = GazeboTeam(server, START, SEEDS), World(START, limited, seeds=SEEDS)
        drive(team, controller, 3.0)
        drive(world, controller, 3.0)
        assert not team.collided[0]
        np.testing.assert_allclose(team.poses, world.poses, atol=0.05)
        assert team.time == pytest.approx(3.0)
        assert team.min_distance[0] == pytest.approx(world.min_distance[0], abs=0.03)
        assert np.abs(team.velocities - world.velocities).max() < 0.1


def test_moments_between_two_steps_of_the_physics_do_not_add_up(gazebo):
    forward = np.tile([0.1, 0.0, 0.0], (1, ROBOTS, 1))
    with GazeboServer(HARDWARE, OPEN, ROBOTS) as server:
        team = GazeboTeam(server, START, SEEDS)
        for _ in range(80):
            team.apply(forward, 1 / 8)
    way = np.linalg.norm(team.poses[0, :, :2] - START[0, :, :2], axis=-1)
    # The lag and the limit of acceleration cost the speed of about 0.1 s.
    np.testing.assert_allclose(way, 0.1 * (10.0 - 0.1), atol=0.01)


def test_robots_come_and_go(gazebo):
    with GazeboServer(IDEAL, OPEN, 2, spare=1) as server:
        team = GazeboTeam(server, [[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]], SEEDS)
        assert team.poses.shape == (1, 2, 3)
        assert team.add_robot(0, [0.0, 1.0, 0.5]) == 2
        np.testing.assert_allclose(team.poses[0, 2], [0.0, 1.0, 0.5], atol=1e-9)
        team.apply(np.zeros((1, 3, 3)), 0.1)
        ranges = team.observe().scans.ranges[0]
        left = round(450 * 3 / 4)
        assert ranges[0, left] == pytest.approx(1.0, abs=0.2)
        with pytest.raises(TriformError, match="spare"):
            team.add_robot(0, [1.0, 1.0, 0.0])
        team.remove_robot(0, 2)
        assert np.isnan(team.poses[0, 2]).all()
        team.apply(np.zeros((1, 3, 3)), 0.1)
        ranges = team.observe().scans.ranges[0]
        assert np.isinf(ranges[2]).all()
        assert np.isinf(ranges[0, left])
        assert team.add_robot(0, [0.0, -1.0, 0.5]) == 2


def test_wrong_use_is_refused_in_a_sentence(gazebo):
    with GazeboServer(IDEAL, OPEN, ROBOTS) as server:
        with pytest.raises(ConfigurationError, match="shape"):
            GazeboTeam(server, np.zeros((2, ROBOTS, 3)))
        with pytest.raises(ConfigurationError, match="finite"):
            GazeboTeam(server, np.full((1, ROBOTS, 3), np.nan))
        team = GazeboTeam(server, START)
        with pytest.raises(TriformError, match="commands of shape"):
            team.apply(np.zeros((1, 2, 3)), 0.1)
        with pytest.raises(TriformError, match="not finite"):
            team.apply(np.full((1, ROBOTS, 3), np.inf), 0.1)
        with pytest.raises(TriformError, match="held for"):
            team.apply(np.zeros((1, ROBOTS, 3)), 0.0)
        for change in (lambda: team.add_robot(1, np.zeros(3)), lambda: team.remove_robot(1, 0)):
            with pytest.raises(TriformError, match="no world 1"):
                change()
    turning = replace(IDEAL, lidar=replace(IDEAL.lidar, angle_noise=0.01))
    aside = replace(IDEAL, mounting=Mounting(x=0.1))
    for profile, told in ((turning, "angle"), (aside, "at the robot's centre")):
        with GazeboServer(profile, OPEN, 1) as server, pytest.raises(ConfigurationError, match=told):
            GazeboTeam(server, np.zeros((1, 1, 3)), SEEDS)


@pytest.mark.parametrize("drive", ["planar", "mecanum"])
def test_an_evaluation_is_the_same_each_time_and_forms_teams(gazebo: Installation, drive):
    runs, duration = (3, 12.0) if drive == "planar" else (2, 6.0)
    given = {"duration": duration, "simulator": "gazebo", "base": drive, "threads": 2}
    config = options(EvaluateConfig, robots=(4,), runs=runs, **given)
    first, second = evaluate(config), evaluate(config)
    for name, column in first.runs.items():
        np.testing.assert_array_equal(column, second.runs[name])
    assert not first.runs["collision"].any()
    if drive == "planar":
        assert first.runs["success"].all()
    # A run does not depend on those before it in the same process.
    scenario, last = config.scenario, runs - 1
    poses = scenario.sample_starts(4, runs, config.seed)
    alone, _ = scenario.run(poses[last:], seed=config.seed, indices=[last])
    together, _ = scenario.run(poses, seed=config.seed)
    np.testing.assert_array_equal(alone.poses[0], together.poses[last])
    assert subprocess.run(["pgrep", "-P", str(os.getpid()), "gzserver"], capture_output=True, check=False).stdout == b""


@pytest.mark.parametrize("kind", ["join", "leave"])
def test_teams_change(gazebo, kind):
    scenario = Scenario(duration=20.0, simulator="gazebo", event=Event(kind, 8.0))
    trajectory, table = scenario.run(scenario.sample_starts(4, 2, 7))
    assert trajectory.active[:, 0].sum(axis=1).tolist() == [4, 4]
    after = 5 if kind == "join" else 3
    assert trajectory.active[:, -1].sum(axis=1).tolist() == [after, after]
    assert table["robots"].tolist() == [after, after]
    assert table["success"].all()


def test_wheels_need_gazebo_and_gazebo_needs_to_be_there(tmp_path, monkeypatch, capsys):
    with pytest.raises(ConfigurationError, match="wheels"):
        Scenario(base="mecanum")
    monkeypatch.setenv("TRIFORM_GAZEBO", str(tmp_path))
    assert main(["evaluate", "--simulator", "gazebo", "--robots", "3", "--runs", "1", "--threads", "1"]) == 1
    assert "make gazebo" in capsys.readouterr().err
