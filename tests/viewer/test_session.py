"""The live team behind a page: its clock, what people do to it, and what is refused."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.control import ControllerSpec
from triform.evaluation.scenario import Scenario
from triform.types import ConfigurationError, TriformError
from triform.viewer.session import SPEEDS, Session, Setup


class Clock:
    """A clock that people turn."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def make(controller="expert", robots=5, clock=time.monotonic, **scenario) -> Session:
    return Session(Setup(Scenario(**scenario), ControllerSpec.parse(controller), robots, 7), 1, clock)


def poses(session: Session) -> np.ndarray:
    return session.picture().formation.poses


def test_steps_are_those_of_an_evaluation_to_the_bit() -> None:
    session, scenario = make(duration=5.0), Scenario(duration=5.0)
    for _ in range(scenario.steps):
        session.step()
    run, _ = scenario.run(scenario.sample_starts(5, 1, 7), "expert", 7, [0])
    np.testing.assert_array_equal(poses(session), run.poses[0, -1])
    assert session.paused
    assert len(session.course().time) == scenario.steps


def test_robots_glide_from_one_record_to_the_next() -> None:
    clock = Clock()
    session = make(clock=clock)
    before = poses(session).copy()
    session._advance()
    after = poses(session)
    assert not np.array_equal(before, after)
    for share in (0.0, 0.25, 1.0, 3.0):
        clock.now = share * session.period
        np.testing.assert_allclose(
            session.picture().poses[:, :2], (before + min(share, 1.0) * (after - before))[:, :2], atol=1e-12
        )


def test_the_clock_of_the_wall_drives_it_until_it_is_paused() -> None:
    session = make()
    session.speed = 4.0
    session.start()
    try:
        began = time.monotonic()
        while session.picture().formation.time < 2.0:
            assert time.monotonic() - began < 20.0
            time.sleep(0.01)
        # At four times real speed, 2 s need half a second, and not less.
        assert time.monotonic() - began > 0.35
        session.pause()
        stands = session.picture().formation.time
        time.sleep(0.2)
        assert session.picture().formation.time == stands
        session.pause(False)
        while session.picture().formation.time == stands:
            time.sleep(0.01)
    finally:
        session.stop()
    assert not any(thread.name == "triform-session" for thread in threading.enumerate())


def test_a_robot_that_is_dragged_away_stays_where_it_is_held_and_comes_back_when_let_go() -> None:
    session = make("expert")
    for _ in range(150):
        session.step()
    assert session.picture().formation.error < 0.1
    far = poses(session)[:, :2].max(axis=0) + 1.0
    session.drag(2, *far)
    assert session.picture().formation.error > 0.1
    for _ in range(20):
        session.step()
    np.testing.assert_array_equal(poses(session)[2, :2], far)
    session.release(2)
    for _ in range(300):
        session.step()
    assert session.picture().formation.error < 0.1
    assert np.linalg.norm(poses(session)[2, :2] - far) > 0.3


def test_robots_come_and_go_under_their_own_numbers() -> None:
    session = make()
    session.remove(1)
    session.remove(3)
    assert session.picture().formation.robots.tolist() == [0, 2, 4]
    # A robot that is dragged keeps its number though lower ones are free.
    session.drag(4, 9.0, 9.0)
    session.release(4)
    assert session.picture().formation.robots.tolist() == [0, 2, 4]
    assert session.add(-9.0, -9.0) == 1
    assert session.picture().formation.robots.tolist() == [0, 1, 2, 4]
    session.step()
    assert len(session.picture().poses) == 4
    assert session.sensing(3) is None
    assert session.sensing(1) is not None


@settings(max_examples=40, deadline=None)
@given(x=st.floats(-4, 4), y=st.floats(-4, 4))
def test_a_robot_is_added_exactly_where_it_overlaps_nothing(x: float, y: float) -> None:
    session = make(arena="room-6")
    outline = session.setup.scenario.robot.footprint
    others = poses(session)[:, :2]
    free = np.linalg.norm(others - [x, y], axis=1).min() > 2 * outline.circumradius
    # A new robot heads along x, so in a room without pillars its box is all that matters.
    inside = abs(abs(x) - 3.0) > outline.half_length and abs(abs(y) - 3.0) > outline.half_width
    if free and inside:
        assert session.add(x, y) == 5
    elif (abs(abs(x) - 3.0) < outline.half_length and abs(y) < 3.0) or not free:
        with pytest.raises(ConfigurationError, match="would stand"):
            session.add(x, y)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"distance": 0.0}, "distance is 0"),
        ({"distance": float("nan")}, "distance is nan"),
        ({"robots": 0}, "robots is 0"),
        ({"robots": 10_000}, "a page shows 1 to 300"),
        ({"seed": -1}, "seed is -1"),
        ({"controller": "magic"}, "no controller 'magic'"),
        ({"profile": "moon"}, "no profile 'moon'"),
        ({"arena": "moon"}, "no arena 'moon'"),
        ({"range_noise": -1.0}, "range_noise is -1"),
        ({"controller": "policy:default", "distance": 3.9}, "distance"),
    ],
)
def test_what_is_refused_leaves_the_team_as_it_was(changes: dict, says: str) -> None:
    session = make()
    session.step()
    before, setup = poses(session).copy(), session.setup
    with pytest.raises(TriformError, match=says):
        session.change(**changes)
    assert session.setup == setup
    np.testing.assert_array_equal(poses(session), before)
    session.step()
    assert session.problem() == ""


def test_another_controller_distance_or_noise_finds_the_robots_where_they_are() -> None:
    session = make()
    for _ in range(10):
        session.step()
    for change in ({"controller": "triangulating"}, {"distance": 1.2}, {"range_noise": 0.01}):
        moment, before = session.picture().formation.time, poses(session).copy()
        session.change(**change)
        np.testing.assert_allclose(poses(session), before, atol=1e-12)
        assert session.picture().formation.time == pytest.approx(moment)
        session.step()
    assert session.setup.scenario.overrides.range_noise == 0.01


@pytest.mark.parametrize("change", [{"robots": 7}, {"seed": 8}, {"arena": "room-6"}, {"profile": "hardware"}])
def test_another_team_or_place_begins_anew(change: dict) -> None:
    session = make()
    session.step()
    session.change(**change)
    formation = session.picture().formation
    assert formation.time == 0.0
    assert len(formation.robots) == session.setup.robots
    session.reset()
    np.testing.assert_array_equal(poses(session), formation.poses)


def test_a_controller_that_fails_stops_the_time_and_says_why_once() -> None:
    session = make("triangulating")

    class Failing:
        privileged = False

        def command(self, view):
            raise TriformError("it is tired")

    session._controller = Failing()
    session.pause(False)
    session._advance()
    assert session.paused
    assert [session.problem(), session.problem()] == ["it is tired", ""]


def test_a_mixed_team_is_dragged_and_sees() -> None:
    session = make("triangulating", profile="turtlebot4:2 hardware:2", robots=4)
    session.drag(0, 8.0, 0.0)
    session.step()
    session.release(0)
    assert poses(session)[0, 0] == pytest.approx(8.0)
    assert session.sensing(3).hits.shape[1] == 2
    session.change(profile="ideal")
    assert session.setup.robots == 4


def test_a_team_in_mujoco_is_changed_and_reached_into_like_the_built_in_one() -> None:
    pytest.importorskip("mujoco")
    session, scenario = make(robots=4, simulator="mujoco", duration=5.0), Scenario(simulator="mujoco", duration=5.0)
    for _ in range(3):
        session.step()
    run, _ = scenario.run(scenario.sample_starts(4, 1, 7), "expert", 7, [0])
    np.testing.assert_array_equal(poses(session), run.poses[0, 3])
    session.remove(1)
    session.drag(3, 6.0, 6.0)
    session.release(3)
    before = poses(session).copy()
    session.change(range_noise=0.01)
    assert session.picture().formation.robots.tolist() == [0, 2, 3]
    np.testing.assert_allclose(poses(session), before, atol=1e-9)
    np.testing.assert_allclose(before[2, :2], 6.0)
    assert session.add(-6.0, -6.0) == 1
    session.step()
    assert session.sensing(1) is not None
    assert session.problem() == ""


def test_speeds_are_those_that_a_page_offers() -> None:
    session = make()
    for speed in SPEEDS:
        session.speed = speed
        assert session.speed == speed
    for wrong in (0.0, -1.0, 1e9, float("nan")):
        with pytest.raises(ConfigurationError, match="speed is"):
            session.speed = wrong


def test_a_robot_sees_others_where_they_are() -> None:
    session = make("expert", robots=3)
    sensing = session.sensing(0)
    others = poses(session)[1:, :2]
    outline = session.setup.scenario.robot.footprint
    gaps = np.linalg.norm(sensing.hits[:, None] - others, axis=2).min(axis=1)
    assert len(gaps) > 0
    assert (gaps < outline.circumradius + 1e-6).all()
    # The map is of the same returns: forward is up, left is left.
    pose, reading = sensing.pose, sensing.reading
    cells, cell = np.argwhere(reading.occupancy), reading.cell
    own = (cells + 0.5 - len(reading.occupancy) / 2) * cell
    turn = np.array([[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]])
    world = pose[:2] + own @ turn.T
    assert np.linalg.norm(world[:, None] - sensing.hits, axis=2).min(axis=1).max() < 2.2 * cell
