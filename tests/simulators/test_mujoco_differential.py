"""Differential robots in MuJoCo: on two driven wheels and casters, and on the planar base."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from triform.evaluation.scenario import Scenario
from triform.simulation import IDEAL, Drive, Footprint, World, get_profile, limit_twists
from triform.simulators.chassis import MASS, braked
from triform.simulators.mujoco import MujocoTeam
from triform.types import ConfigurationError

TURTLEBOT4, BURGER = get_profile("turtlebot4"), get_profile("turtlebot3-burger")
GRAVITY = 9.81
seeds = st.integers(0, 2**32)


def exact(profile):
    """Robots of a profile whose LiDAR has no errors and casts few rays, for tests of motion."""
    lidar = replace(profile.lidar, noise=(), dropout=0.0, scan=replace(profile.lidar.scan, rays=8))
    return replace(profile, lidar=lidar, drive=braked(profile.drive))


def turned_by(headings):
    return np.abs(np.angle(np.exp(1j * headings)))


def rolled(base, command, drive, duration):
    """Pose after driving from rest, by SciPy: ``v' = (u - v) / lag`` within the limits of acceleration."""
    speed, _, turn = limit_twists(np.array(command), drive)

    def motion(_, state):
        heading, v, omega = state[2:]
        gaps = (speed - v) / drive.lag, (turn - omega) / drive.lag
        limits = drive.max_acceleration, drive.max_turn_acceleration
        return [v * np.cos(heading), v * np.sin(heading), omega, *np.clip(gaps, np.negative(limits), limits)]

    return solve_ivp(motion, (0.0, duration), [*base, 0.0, 0.0], rtol=1e-9, atol=1e-9).y[:3, -1]


@settings(max_examples=15, deadline=None)
@given(seed=seeds, name=st.sampled_from(["turtlebot4", "turtlebot3-burger", "turtlebot3-waffle"]))
def test_wheels_drive_the_arcs_that_commands_ask_for(seed, name):
    rng, profile = np.random.default_rng(seed), exact(get_profile(name))
    limits, robots = profile.drive, 4
    commands = rng.uniform(-1, 1, (robots, 3)) * [limits.max_speed, 0.0, 0.8 * limits.max_turn_rate]
    start = np.column_stack([3.0 * np.arange(robots), np.zeros(robots), rng.uniform(-np.pi, np.pi, robots)])
    team = MujocoTeam(start[None], profile, base="differential")
    team.apply(commands[None], 2.0)
    expected = np.array([rolled(base, each, limits, 2.0) for base, each in zip(start, commands, strict=True)])
    # At most 0.61 m of way and 4 radians.
    np.testing.assert_allclose(team.poses[0, :, :2], expected[:, :2], atol=4e-3)
    assert turned_by(team.poses[0, :, 2] - expected[:, 2]).max() < 0.01


@pytest.mark.parametrize(("base", "position", "heading"), [("planar", 3e-3, 0.025), ("differential", 1.5e-3, 0.015)])
@pytest.mark.parametrize("profile", [TURTLEBOT4, BURGER], ids=["turtlebot4", "burger"])
def test_robots_move_as_in_the_built_in_world(profile, base, position, heading):
    """Under holonomic commands that change twice a second, which become speeds along arcs in both."""
    profile, robots = exact(profile), 6
    start = np.array([[(3.0 * i, 0.0, 0.9 * i) for i in range(robots)]])
    team, world, rng = MujocoTeam(start, profile, base=base), World(start, profile), np.random.default_rng(3)
    sideways = 0.0
    for period in range(40):
        if period % 5 == 0:
            commands = rng.normal(0, 0.2, (1, robots, 3))
        team.apply(commands, 0.1)
        world.apply(commands, 0.1)
        sideways = max(sideways, np.abs(team.velocities[..., 1]).max())
        np.testing.assert_allclose(team.poses[..., :2], world.poses[..., :2], atol=position)
        assert turned_by((team.poses - world.poses)[..., 2]).max() < heading
        seen, expected = team.observe().odometry, world.observe().odometry
        np.testing.assert_allclose(seen[..., :2], expected[..., :2], atol=position)
        assert turned_by((seen - expected)[..., 2]).max() < heading
    assert sideways < (1e-9 if base == "planar" else 5e-3)
    assert np.abs(world.poses - start)[..., :2].max() > 0.1


@pytest.mark.parametrize("base", ["planar", "differential"])
def test_a_robot_that_may_not_reverse_turns_to_where_it_is_to_go(base):
    profile = exact(replace(TURTLEBOT4, drive=replace(TURTLEBOT4.drive, reverse=False)))
    team = MujocoTeam([[[0.0, 0.0, 0.0]]], profile, base=base)
    slowest = 0.0
    for _ in range(60):
        heading = team.poses[0, 0, 2]
        # Wanted velocity: backwards in the world frame.
        team.apply(np.array([[[-0.2 * np.cos(heading), 0.2 * np.sin(heading), 0.0]]]), 0.1)
        slowest = min(slowest, team.velocities[0, 0, 0])
    assert slowest > -1e-3
    assert turned_by(team.poses[0, 0, 2] - np.pi) < 0.05
    assert team.poses[0, 0, 0] < -0.4


@pytest.mark.parametrize("profile", [TURTLEBOT4, BURGER], ids=["turtlebot4", "burger"])
def test_wheels_hardly_slip_and_stand_where_they_were_stopped(profile):
    profile = exact(profile)
    limits = profile.drive
    commands = np.array([[[limits.max_speed, 0, 0], [-0.2, 0, 0.6], [0.1, 0, -1.5], [0, 0, limits.max_turn_rate]]])
    start = np.array([[(3.0 * i, 0.0, 0.9 * i) for i in range(4)]])
    team = MujocoTeam(start, profile, base="differential")
    motion, slip, tilt = team._motion, [], []
    for k in range(150):
        team.apply(commands * (k < 100), 0.01)
        wheels = motion._wheels * limits.wheel_radius
        along, turn = wheels.mean(axis=-1), (wheels[..., 1] - wheels[..., 0]) / limits.track
        slip.append(team.velocities - np.stack([along, np.zeros_like(along), turn], axis=-1))
        tilt.append(2 * np.hypot(*motion.frames[..., 4:6].T).max())
    assert max(tilt) < np.radians(0.1)
    # While accelerating, driving and braking: 1 mm/s along the axis, 3 mm/s across it, 0.5 degrees per second.
    assert (np.abs(slip).max(axis=(0, 1, 2)) < [1e-3, 3e-3, 0.01]).all()
    still = np.zeros_like(commands)
    team.apply(still, 1.0)
    rest = team.poses
    team.apply(still, 2.0)
    # Less than 0.1 mm/s and 0.03 degrees per second.
    np.testing.assert_allclose((team.poses - rest)[..., :2], 0.0, atol=2e-4)
    assert turned_by((team.poses - rest)[..., 2]).max() < 1e-3


def test_the_wheels_carry_the_robot():
    import mujoco

    team = MujocoTeam([[[0.0, 0.0, 0.5]]], exact(TURTLEBOT4), base="differential")
    team.apply(np.zeros((1, 1, 3)), 1.0)
    model = team._batch.model
    data = mujoco.MjData(model)
    data.qpos[:] = team._batch.qpos[0]
    mujoco.mj_forward(model, data)
    forces, force = {}, np.zeros(6)
    for k, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, k, force)
        forces[model.geom(contact.geom2 or contact.geom1).name] = force[0]
    assert sum(forces.values()) == pytest.approx(MASS * GRAVITY, rel=1e-3)
    assert forces["left0"] == pytest.approx(forces["right0"], rel=1e-3)
    assert forces["left0"] + forces["right0"] > 0.85 * MASS * GRAVITY


@pytest.mark.parametrize("share", [0.8, 1.2])
def test_wheels_hold_a_robot_that_is_pushed_aside_as_coulomb_says(share):
    """The largest force is friction, 1, times the weight; the wheels carry nearly all of it."""
    team = MujocoTeam([[[0.0, 0.0, 0.0]]], exact(TURTLEBOT4), base="differential")
    still = np.zeros((1, 1, 3))
    team.apply(still, 0.5)
    team._batch.qfrc_applied[0, 1] = share * MASS * GRAVITY
    team.apply(still, 0.5)
    assert (team.velocities[0, 0, 1] > 0.1) if share > 1 else (team.velocities[0, 0, 1] < 3e-3)


def test_robots_that_push_each_other_are_solid():
    """One drives against the other's side, which slides off; then against its front, which drives too."""
    team = MujocoTeam(
        [[[0, 0, 0], [0.5, 0, np.pi / 2]], [[0, 0, 0], [0.5, 0, np.pi]]], exact(TURTLEBOT4), base="differential"
    )
    commands = np.array([[[0.3, 0, 0], [0, 0, 0]], [[0.3, 0, 0], [0.3, 0, 0]]], dtype=float)
    for _ in range(30):
        team.apply(commands, 0.1)
        apart = np.linalg.norm(team.poses[:, 0, :2] - team.poses[:, 1, :2], axis=-1)
        assert (apart > TURTLEBOT4.footprint.length - 0.01).all()
    assert team.collided.all()
    # Equal wheels: neither pushes the other away.
    np.testing.assert_allclose(team.poses[1, :, :2].mean(axis=0), [0.25, 0.0], atol=0.05)


def test_a_team_of_turtlebots_forms_and_stands():
    scenario = Scenario(profile="turtlebot4", duration=60.0, simulator="mujoco", base="differential")
    _, table = scenario.run(scenario.sample_starts(3, 2, 7))
    assert table["success"].all()
    assert not table["collision"].any()
    assert (table["settled_speed"] < 5e-3).all()


def test_bases_fit_robots():
    for base, robots, own in (
        ("differential", IDEAL, "planar or a mecanum"), ("mecanum", TURTLEBOT4, "planar or a differential"),
    ):  # fmt: skip
        with pytest.raises(ConfigurationError, match=own):
            MujocoTeam([[[0, 0, 0]]], robots, base=base)
        with pytest.raises(ConfigurationError, match=own):
            Scenario(profile=robots.name, simulator="mujoco", base=base)
    with pytest.raises(ConfigurationError, match="Gazebo drives holonomic robots alone"):
        Scenario(profile="turtlebot4", simulator="gazebo", base="differential")
    with pytest.raises(ConfigurationError, match="it goes with simulator mujoco"):
        Scenario(profile="turtlebot4", base="differential")
    for track, size in ((0.0, 0.3), (0.3, 0.3)):
        rolling = Drive(kind="differential", max_turn_rate=2.0, track=track)
        robots = replace(IDEAL, footprint=Footprint.circle(size), drive=rolling)
        with pytest.raises(ConfigurationError, match=f"track is {track} m"):
            MujocoTeam(
                [[[0, 0, 0]]], replace(IDEAL, footprint=Footprint.circle(size), drive=rolling), base="differential"
            )
    for radius in (1e-6, 0.2, 1.5):
        rolling = Drive(kind="differential", max_turn_rate=2.0, track=0.2, wheel_radius=radius)
        with pytest.raises(ConfigurationError, match=f"wheel_radius is {radius} m; in a simulator"):
            MujocoTeam([[[0, 0, 0]]], replace(IDEAL, drive=rolling), base="differential")
    for radius in (0.0, -1.0, math.inf):
        with pytest.raises(ConfigurationError, match="wheel_radius is"):
            Drive(wheel_radius=radius)
