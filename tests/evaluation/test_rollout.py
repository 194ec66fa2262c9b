from __future__ import annotations

import numpy as np
import pytest

from triform.control import CONTROLLERS, drive, make_controller
from triform.evaluation import Trajectory, rollout
from triform.types import ConfigurationError, PrivilegedView, Scan, ScanConfig, TriformError, View


class Team:
    """Moves points by the commands as they are, and writes down the order of events."""

    control_period = 0.25

    def __init__(self, worlds=2, robots=3):
        self.poses = np.zeros((worlds, robots, 3))
        self.steps = 0
        self.events = []

    def observe(self):
        self.events.append("observe")
        scans = Scan(np.full((*self.poses.shape[:2], 8), np.inf), ScanConfig(rays=8))
        active = np.ones(self.poses.shape[:2], dtype=bool)
        return PrivilegedView(scans, active, self.steps * self.control_period, self.poses)

    def apply(self, commands, duration):
        self.events.append("apply")
        self.poses += commands * duration
        self.steps += 1


class BlindTeam(Team):
    def observe(self):
        view = super().observe()
        return View(view.scans, view.active, view.time)


class Forward:
    privileged = False
    description = {"name": "forward"}  # noqa: RUF012

    def command(self, view):
        return np.broadcast_to([1.0, 0.0, 0.5], (*view.active.shape, 3))


def test_rollout_records_poses_and_commands_on_the_same_clock():
    trajectory = rollout(Team(), Forward(), 2.0)
    np.testing.assert_allclose(trajectory.time, np.arange(9) * 0.25)
    assert trajectory.poses.shape == (2, 9, 3, 3)
    assert trajectory.commands.shape == (2, 8, 3, 3)
    assert trajectory.period == pytest.approx(0.25)
    np.testing.assert_allclose(trajectory.positions[..., 0], np.broadcast_to(trajectory.time[:, None], (2, 9, 3)))
    steps = np.diff(trajectory.poses, axis=1)
    np.testing.assert_allclose(steps, trajectory.commands * 0.25)


def test_every_period_senses_decides_and_moves_in_this_order():
    team, seen = Team(), []
    drive(team, Forward(), 0.5, lambda view, commands: seen.append((view.time, commands.shape)))
    assert team.events == ["observe", "apply"] * 2
    assert seen == [(0.0, (2, 3, 3)), (0.25, (2, 3, 3))]


def test_any_team_can_be_driven_without_true_poses():
    team = BlindTeam(1, 1)
    drive(team, Forward(), 1.0)
    assert team.poses[0, 0, 0] == pytest.approx(1.0)


@pytest.mark.parametrize("name", [name for name in CONTROLLERS if name.startswith("expert")])
def test_a_controller_that_needs_true_poses_is_refused_by_a_team_without(name):
    team = BlindTeam()
    with pytest.raises(TriformError, match=f"^the controller '{name}' needs everybody's true pose[^\n]+$"):
        drive(team, make_controller(name), 1.0)
    assert team.events == ["observe"]
    assert not team.poses.any()


def test_progress_is_reported_once_per_period():
    calls = []
    rollout(Team(), Forward(), 1.0, lambda: calls.append(1))
    assert len(calls) == 4


@pytest.mark.parametrize("duration", [0.0, -1.0, 0.3, np.nan, np.inf])
def test_durations_that_are_no_whole_number_of_periods_are_refused(duration):
    with pytest.raises(ConfigurationError, match=r"whole number of control periods of 0\.25 s"):
        rollout(Team(), Forward(), duration)


def test_run_and_since_cut_along_worlds_and_time():
    trajectory = rollout(Team(), Forward(), 2.0)
    one = trajectory.run(1).since(1.0)
    assert one.poses.shape == (1, 5, 3, 3)
    assert one.commands.shape == (1, 4, 3, 3)
    assert one.time[0] == pytest.approx(1.0)


def test_then_joins_at_the_moment_of_change_and_widens_the_team():
    team = Team()
    before = rollout(team, Forward(), 1.0)
    larger = Team(robots=4)
    larger.steps = team.steps
    after = rollout(larger, Forward(), 0.5)
    joined = before.then(after)
    assert isinstance(joined, Trajectory)
    np.testing.assert_allclose(joined.time, np.arange(7) * 0.25)
    assert joined.poses.shape == (2, 7, 4, 3)
    assert joined.commands.shape == (2, 6, 4, 3)
    assert np.isnan(joined.poses[:, :4, 3]).all()
    np.testing.assert_array_equal(joined.active[0].sum(axis=-1), [3, 3, 3, 3, 4, 4, 4])
