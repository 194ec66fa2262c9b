"""One real robot as a team: what it sees, what it sends, and the ticks of its clock."""

from __future__ import annotations

import time
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.control import drive
from triform.robots.laser_scan import Turn
from triform.robots.real import RealRobot, Step
from triform.simulation import ROBOMASTER_EP, Drive, Mounting, Placement, integrate
from triform.types import ConfigurationError, ScanConfig, TriformError, View

SCAN = ScanConfig(rays=90)
LIMITS = Drive(max_axis_speed=0.1, max_turn_rate=1.0)


class FakeLidar:
    scan = SCAN

    def __init__(self, turn: Turn | None = None) -> None:
        self.turn = turn
        self.lost = False

    def latest(self) -> Turn | None:
        if self.lost:
            raise TriformError("the LiDAR is lost")
        return self.turn


class FakeBase:
    """Wheels that follow a constant body twist from the pose 0 at the time ``began``."""

    def __init__(self, twist: tuple[float, float, float] = (0.0, 0.0, 0.0), knows: bool = True) -> None:
        self.twist, self.knows, self.began = np.array(twist), knows, time.monotonic()
        self.commands: list[np.ndarray] = []

    def drive(self, command: np.ndarray) -> None:
        self.commands.append(command.copy())

    def stop(self) -> None:
        self.commands.append(np.zeros(3))

    def odometry(self, at: float) -> np.ndarray | None:
        return integrate(np.zeros(3), self.twist, at - self.began) if self.knows else None


class Forward:
    """A controller that always drives on."""

    privileged = False
    description: ClassVar[dict[str, Any]] = {"name": "forward"}

    def command(self, view: View) -> np.ndarray:
        return np.full((1, 1, 3), 0.05)


def fresh_turn(age: float = 0.05, value: float = 1.0) -> Turn:
    now = time.monotonic()
    return Turn(np.full(SCAN.rays, value, np.float32), now - age - 0.1, now - age)


def make_robot(lidar: FakeLidar, base: FakeBase | None, period: float = 0.01, **options: object) -> RealRobot:
    return RealRobot(lidar, base, period, 3, LIMITS, **options)


def test_nothing_is_seen_and_nothing_driven_before_the_first_turn() -> None:
    lidar, base = FakeLidar(), FakeBase()
    robot = make_robot(lidar, base)
    view = robot.observe()
    assert view.scans.ranges.shape == (1, 1, 90)
    assert np.isposinf(view.scans.ranges).all()
    assert view.active.tolist() == [[True]]
    assert view.odometry is None
    robot.apply(np.full((1, 1, 3), 0.05), 0.01)
    np.testing.assert_array_equal(base.commands, [np.zeros(3)])


def test_an_old_scan_is_no_scan_and_stops_the_robot_once_announced() -> None:
    said: list[str] = []
    lidar, base = FakeLidar(fresh_turn(age=0.6)), FakeBase()
    robot = make_robot(lidar, base, warn=said.append)
    for _ in range(3):
        assert np.isnan(robot.observe().scans.ranges).all()
        robot.apply(np.full((1, 1, 3), 0.05), 0.01)
    np.testing.assert_array_equal(base.commands, np.zeros((3, 3)))
    assert said == ["no new scan for 0.5 s: the robot stands still until one comes"]
    lidar.turn = fresh_turn()
    np.testing.assert_array_equal(robot.observe().scans.ranges[0, 0], lidar.turn.ranges)
    robot.apply(np.full((1, 1, 3), 0.05), 0.01)
    np.testing.assert_array_equal(base.commands[-1], np.full(3, 0.05))
    lidar.turn = fresh_turn(age=1.0)
    robot.observe()
    assert len(said) == 2


def test_a_view_shows_how_bright_returns_are_from_wherever_the_lidar_is() -> None:
    """A LiDAR ahead of the centre: a near return on the left is bright, a far one on the right dim."""
    ranges, levels = np.full(SCAN.rays, np.inf, np.float32), np.zeros(SCAN.rays, np.float32)
    left, right = np.abs(SCAN.angles - 1.5) < 0.2, np.abs(SCAN.angles + 1.5) < 0.2
    ranges[left], ranges[right] = 0.8, 1.4
    levels[left], levels[right] = 240.0, 130.0
    now = time.monotonic()
    lidar = FakeLidar(Turn(ranges, now - 0.1, now, levels))
    for mounting in (Mounting(), Mounting(0.1)):
        robot = make_robot(lidar, None, placement=Placement(SCAN, mounting))
        scans = robot.observe().scans
        assert scans.intensities is not None
        shown = scans.ranges[0, 0]
        np.testing.assert_array_equal(
            scans.intensities[0, 0], np.where(shown < 1.1, 240.0, np.where(shown < np.inf, 130.0, 0.0))
        )
        assert np.isfinite(shown).sum() >= 10


class Eyes:
    """A LiDAR that hands out turns one by one, and a robot that drives on."""

    def __init__(self, first: np.ndarray, **options: object) -> None:
        self.said: list[str] = []
        self.base, self.lidar = FakeBase(), FakeLidar()
        self.robot = make_robot(self.lidar, self.base, 1e-4, warn=self.said.append, **options)
        self.show(first)

    def show(self, ranges: np.ndarray) -> float:
        """Drive a step by a new turn; return the share of the command that is sent."""
        now = time.monotonic()
        self.lidar.turn = Turn(ranges.astype(np.float32), now - 0.1, now)
        self.robot.observe()
        self.robot.apply(np.full((1, 1, 3), 0.05), 1e-4)
        return float(self.base.commands[-1][0] / 0.05)


FREE = np.full(SCAN.rays, np.inf)
SOMEBODY = np.where(np.arange(SCAN.rays) == 40, 1.0, np.inf)


@pytest.mark.parametrize(
    "blind",
    [FREE, np.full(SCAN.rays, np.nan), np.where(np.arange(SCAN.rays) < 46, np.nan, 1.0)],
    ids=["no return", "no measurement", "more than half unknown"],
)
def test_a_robot_whose_lidar_measures_nothing_slows_stands_says_so_once_and_goes_on(blind: np.ndarray) -> None:
    eyes = Eyes(SOMEBODY)
    assert [round(eyes.show(blind), 6) for _ in range(6)] == [0.666667, 0.333333, 0, 0, 0, 0]
    assert len(eyes.said) == 1
    assert "stands still until it sees again" in eyes.said[0]
    assert eyes.show(SOMEBODY) == 1
    assert eyes.show(blind) == pytest.approx(2 / 3)
    assert len(eyes.said) == 1


def test_a_robot_that_has_never_seen_anything_stands_from_its_first_turn_on() -> None:
    eyes = Eyes(FREE)
    assert [eyes.show(FREE) for _ in range(3)] == [0, 0, 0]
    assert len(eyes.said) == 1


def test_a_return_from_beyond_what_the_robot_uses_shows_that_its_lidar_measures() -> None:
    eyes = Eyes(7 * SOMEBODY, placement=Placement(SCAN))
    assert [eyes.show(7 * SOMEBODY) for _ in range(5)] == [1] * 5
    assert np.isposinf(eyes.robot.observe().scans.ranges).all()


def test_the_same_turn_seen_again_and_again_counts_once() -> None:
    eyes = Eyes(SOMEBODY)
    eyes.show(FREE)
    for _ in range(5):
        eyes.robot.observe()
        eyes.robot.apply(np.full((1, 1, 3), 0.05), 1e-4)
    assert eyes.base.commands[-1][0] == pytest.approx(0.05 * 2 / 3)


def test_what_is_within_the_robots_own_outline_is_unknown_said_once_and_no_sign_of_sight() -> None:
    placement = Placement(SCAN, body=ROBOMASTER_EP.body)
    arm = np.where(np.abs(SCAN.angles) < 0.2, 0.12, np.inf)
    eyes = Eyes(arm, placement=placement)
    assert [eyes.show(arm) for _ in range(4)] == [0] * 4
    ranges = eyes.robot.observe().scans.ranges[0, 0]
    np.testing.assert_array_equal(np.isnan(ranges), np.abs(SCAN.angles) < 0.2)
    assert [("own outline" in sentence, "stands" in sentence) for sentence in eyes.said] == [
        (True, False),
        (False, True),
    ]
    assert eyes.show(np.where(arm < 1, arm, SOMEBODY)) == 1
    assert len(eyes.said) == 2


@settings(deadline=None, max_examples=30)
@given(st.tuples(*[st.floats(-0.1, 0.1)] * 2, st.floats(-0.5, 0.5)), st.floats(0.0, 0.4), st.floats(0.05, 0.3))
def test_moved_is_where_the_robot_is_seen_from_the_middle_of_the_turn(
    twist: tuple[float, float, float], age: float, length: float
) -> None:
    """A constant body twist: the pose after a time is the same from wherever the time is counted."""
    base = FakeBase(twist)
    now = time.monotonic()
    turn = Turn(np.ones(SCAN.rays, np.float32), now - age - length, now - age)
    robot = make_robot(FakeLidar(turn), base)
    before = time.monotonic()
    odometry = robot.observe().odometry
    after = time.monotonic()
    middle = now - age - length / 2
    earliest, latest = (integrate(np.zeros(3), base.twist, at - middle) for at in (before, after))
    slack = 1e-9 + np.abs(base.twist).max() * (after - before) * 2
    assert odometry is not None
    assert np.abs(odometry[0, 0] - earliest).max() <= slack + np.abs(latest - earliest).max()


class LeapingBase(FakeBase):
    """Says something wrong now, after the truth."""

    def __init__(self, wrong: list[float]) -> None:
        super().__init__()
        self.wrong = wrong

    def odometry(self, at: float) -> np.ndarray | None:
        return np.array(self.wrong) if at > time.monotonic() - 0.05 else np.zeros(3)


@pytest.mark.parametrize("wrong", [1000.0, 1e308, -1e308, np.nan, np.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_what_no_wheels_can_have_done_is_no_odometry(wrong: float, axis: int) -> None:
    pose = [0.0, 0.0, 0.0]
    pose[axis] = wrong
    odometry = make_robot(FakeLidar(fresh_turn()), LeapingBase(pose)).observe().odometry
    if odometry is not None:
        # A heading is wrapped, and some turn is near.
        assert axis == 2
        assert np.abs(odometry).max() <= np.pi


def test_no_odometry_where_the_base_does_not_know_or_nobody_wants_it() -> None:
    lidar = FakeLidar(fresh_turn())
    assert make_robot(lidar, FakeBase(knows=False)).observe().odometry is None
    assert make_robot(lidar, FakeBase(), odometry=False).observe().odometry is None
    assert make_robot(lidar, None).observe().odometry is None
    assert make_robot(lidar, FakeBase()).observe().odometry is not None


def test_a_differential_base_stands_while_its_odometry_is_missing_and_says_so_once_after_a_while() -> None:
    said: list[str] = []
    lidar, base = FakeLidar(fresh_turn()), FakeBase(knows=False)
    wheels = Drive(max_speed=0.3, max_turn_rate=1.0, kind="differential")
    robot = RealRobot(lidar, base, 0.01, 3, wheels, warn=said.append, scan_timeout=0.2)

    def step() -> np.ndarray:
        lidar.turn = fresh_turn()
        robot.observe()
        robot.apply(np.array([[[0.05, 0.0, 0.0]]]), 0.01)
        return base.commands[-1]

    assert robot.standing == "there is no scan that can be used"
    began = time.monotonic()
    while time.monotonic() < began + 0.15:
        assert not step().any()
        assert said == []
    while time.monotonic() < began + 0.5:
        assert not step().any()
    assert said == [robot.standing]
    assert "odometry" in robot.standing
    base.knows = True
    np.testing.assert_array_equal(step(), [0.05, 0.0, 0.0])
    assert robot.standing == ""
    # Without odometry its filter allows for all that it may have turned, and a holonomic base needs none.
    for limits, wanted in ((wheels, False), (LIMITS, True)):
        blind = RealRobot(lidar, FakeBase(knows=False), 0.01, 3, limits, odometry=wanted)
        blind.observe()
        assert blind.standing == ""


def test_pushes_are_those_of_its_own_seed_and_small_for_a_slow_base() -> None:
    slow = RealRobot(FakeLidar(), None, 0.1, 5, LIMITS).observe().noise
    fast = RealRobot(FakeLidar(), None, 0.1, 5, Drive()).observe().noise
    other = RealRobot(FakeLidar(), None, 0.1, 6, LIMITS).observe().noise
    np.testing.assert_allclose(slow, np.sqrt(0.2) * fast)
    assert (slow != other).all()


def test_commands_are_cut_to_the_limits_and_refused_if_not_finite() -> None:
    base = FakeBase()
    robot = make_robot(FakeLidar(fresh_turn()), base)
    robot.observe()
    robot.apply(np.array([[[0.3, -0.05, -7.0]]]), 0.01)
    np.testing.assert_allclose(base.commands, [[0.1, -0.05, -1.0]])
    for bad in (np.full((1, 1, 3), np.nan), np.zeros((1, 2, 3))):
        with pytest.raises(TriformError, match="cannot be driven"):
            robot.apply(bad, 0.01)


def test_the_clock_is_steady_and_late_ticks_are_not_made_up_for() -> None:
    sent: list[float] = []
    robot = make_robot(FakeLidar(fresh_turn()), FakeBase(), 0.02, on_sent=lambda step: sent.append(step.sent))
    began = time.monotonic()
    for k in range(12):
        robot.observe()
        if k == 5:
            time.sleep(0.15)
        robot.apply(np.zeros((1, 1, 3)), 0.02)
    assert robot.late_ticks >= 1
    assert time.monotonic() - began >= 11 * 0.02 + 0.15 - 1e-3
    # The clock starts anew from the late one, and no burst follows.
    assert sent[11] - sent[5] >= 5 * 0.02 - 1e-9


def test_every_step_is_told_with_its_times() -> None:
    steps: list[Step] = []
    lidar, base = FakeLidar(fresh_turn(0.0)), FakeBase()
    robot = make_robot(lidar, base, on_sent=steps.append, scan_timeout=60.0)
    drive(robot, Forward(), 0.05)
    assert len(steps) == len(base.commands) == 5
    for step, command in zip(steps, base.commands, strict=True):
        assert step.seen <= step.decided <= step.sent
        assert step.turn is lidar.turn
        assert step.pose is not None
        assert not step.blind
        np.testing.assert_array_equal(step.command, np.full(3, 0.05))
        np.testing.assert_array_equal(step.command, command)
    assert [step.seen for step in steps] == sorted(step.seen for step in steps)


def test_a_lost_lidar_ends_the_run() -> None:
    lidar = FakeLidar(fresh_turn())
    lidar.lost = True
    with pytest.raises(TriformError, match="LiDAR is lost"):
        drive(make_robot(lidar, FakeBase()), Forward(), 0.05)


@pytest.mark.parametrize("options", [{"scan_timeout": 0.0}, {"period": 0.0}])
def test_bad_settings_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError):
        make_robot(FakeLidar(), None, **options)
