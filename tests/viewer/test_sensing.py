"""What a picked robot shows: its policy's command, the attention, and what the filter allows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from triform.control import ControllerSpec, SafetyFilter, SafetySettings, free_velocities
from triform.evaluation.filters import team_settings
from triform.evaluation.scenario import Scenario
from triform.geometry import body_to_world, gabriel_graph
from triform.perception import label_groups
from triform.types import FloatArray, View
from triform.viewer.reading import NEIGHBOUR, PolicyReader
from triform.viewer.sensing import Sensing
from triform.viewer.session import Session, Setup


def make(controller: str = "policy", robots: int = 7, seed: int = 7, **scenario: object) -> Session:
    return Session(Setup(Scenario(**scenario), ControllerSpec.parse(controller), robots, seed), 1)


def seen(session: Session, robot: int) -> Sensing:
    sensing = session.sensing(robot)
    assert sensing is not None
    return sensing


@pytest.mark.parametrize("profile", ["ideal", "hardware"])
def test_the_reading_is_that_behind_the_command(profile: str) -> None:
    session = make(profile=profile)
    for _ in range(12):
        session.step()
    view, wanted, _ = session._seen
    spec = PolicyReader(None)._spec
    for robot in range(7):
        sensing = seen(session, robot)
        assert sensing.reading is not None
        assert sensing.reading.twist is not None
        # All that is missing is exploration noise, which goes along the robot's own random direction.
        rest = (sensing.wanted - sensing.reading.twist)[:2]
        noise = view.noise[0, robot]
        across = noise[0] * rest[1] - noise[1] * rest[0]
        assert abs(across) < 1e-6 * max(1.0, float(np.linalg.norm(noise)))
        np.testing.assert_array_equal(sensing.wanted, wanted[0, robot])
        assert spec.distance == 1.0


def test_groups_are_those_of_scipy() -> None:
    rng = np.random.default_rng(3)
    for share in (0.0, 0.1, 0.4, 0.6, 1.0):
        occupancy = (rng.random((40, 40)) < share).astype(np.uint8)
        labels, count = label_groups(occupancy)
        expected, groups = ndimage.label(occupancy)
        assert count == groups
        np.testing.assert_array_equal(labels, expected)


def test_what_gets_attention_is_a_neighbour_of_the_gabriel_graph() -> None:
    found, right = [], []
    for seed in (7, 8):
        session = make(robots=9, seed=seed)
        for step in range(90):
            session.step()
            if step % 40 != 5:
                continue
            poses = session._seen[0].poses[0]
            graph = gabriel_graph(np.ascontiguousarray(poses[:, :2]))
            for robot in range(9):
                reading = seen(session, robot).reading
                assert reading is not None
                assert reading.groups is not None
                places = poses[robot, :2] + body_to_world(reading.groups.centres, poses[robot, 2])
                gaps = np.linalg.norm(places[:, None] - poses[:, :2], axis=2)
                gaps[:, robot] = np.inf
                right += graph[robot, gaps.argmin(axis=1)].tolist()
                found += reading.groups.neighbours.tolist()
    one, other = np.array(found), np.array(right)
    assert (one & other).sum() / one.sum() > 0.8
    assert (one & other).sum() / other.sum() > 0.9
    assert NEIGHBOUR == 0.1


def test_other_controllers_have_a_map_and_no_attention() -> None:
    reading = seen(make("triangulating"), 0).reading
    assert reading is not None
    assert (reading.attention, reading.groups, reading.twist) == (None, None, None)
    reading = seen(make("policy:cnn"), 0).reading
    assert reading is not None
    assert reading.groups is not None
    assert reading.attention is None
    assert not reading.groups.neighbours.any()
    assert (reading.groups.changes > 0).any()


class _Wants:
    privileged = False

    def __init__(self, command: FloatArray) -> None:
        self._command = command

    @property
    def description(self) -> dict[str, object]:
        return {"name": "wants"}

    def command(self, view: View) -> FloatArray:
        commands = np.zeros((*view.active.shape, 3))
        commands[0, 2] = self._command
        return commands


@pytest.mark.parametrize(("profile", "turn"), [("ideal", 0.0), ("ideal", 0.3), ("hardware", 0.0), ("turtlebot4", 0.0)])
def test_the_edge_of_what_is_free_is_where_the_filter_begins_to_act(profile: str, turn: float) -> None:
    scenario = Scenario(profile=profile, arena="room-6")
    session = make("expert", profile=profile, arena="room-6")
    session.step()
    view = session._seen[0]
    (rules,) = team_settings(scenario.driven)
    rules = SafetySettings(**{**vars(rules), "pace": 1.0})
    free, limiting = free_velocities(view, 2, rules, turn, 0.8)
    assert len(free) == (120 if rules.arcs is None else 2)
    for velocity, ray in zip(free, limiting, strict=True):
        inside, outside = (np.array([*share * velocity, turn]) for share in (0.999, 1.001))
        np.testing.assert_allclose(SafetyFilter(_Wants(inside), rules).command(view)[0, 2, :2], inside[:2], atol=1e-9)
        if ray >= 0:
            got = SafetyFilter(_Wants(outside), rules).command(view)[0, 2, :2]
            assert np.linalg.norm(got - outside[:2]) > 1e-5 * np.linalg.norm(velocity)
    if profile == "ideal":
        assert (limiting >= 0).any()


def test_what_a_robot_gets_is_within_what_is_free() -> None:
    session = make("expert", arena="room-6", robots=5)
    for _ in range(20):
        session.step()
        sensing = seen(session, 1)
        assert sensing.free is not None
        speed = min(np.hypot(*sensing.command[:2]), session.setup.scenario.robot.drive.max_speed)
        angle = np.arctan2(sensing.command[1], sensing.command[0])
        angles = np.arctan2(sensing.free[:, 1], sensing.free[:, 0])
        nearest = np.abs(np.angle(np.exp(1j * (angles - angle)))).argsort()[:2]
        assert speed <= np.hypot(*sensing.free[nearest].T).max() * 1.01
    assert seen(make("expert", guard="none"), 0).free is None


def test_a_mixed_team_shows_wanted_and_allowed_of_each_kind() -> None:
    session = make("triangulating", profile="turtlebot4:2 hardware:2", robots=4)
    for _ in range(30):
        session.step()
    kinds = [seen(session, robot).free for robot in (1, 3)]
    assert [None if free is None else len(free) for free in kinds] == [2, 120]
    for robot in range(4):
        assert np.isfinite(seen(session, robot).wanted).all()
