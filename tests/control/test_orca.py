"""ORCA: discs that pass each other by plain geometry, half-planes against SciPy, and what it leaves alone."""

from __future__ import annotations

import copy
import json
import pickle
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from tests.controllers import Given
from triform.control import OrcaFilter, OrcaSettings, SafetyFilter, make_controller
from triform.evaluation import Scenario
from triform.evaluation.events import Event
from triform.evaluation.overrides import Overrides
from triform.simulation import IDEAL, Footprint, World
from triform.simulation.arena import get_arena
from triform.types import ConfigurationError, FloatArray, PrivilegedView, Scan, ScanConfig, TriformError, View

RADIUS = 0.2
SETTINGS = OrcaSettings(RADIUS)
CONFIG = ScanConfig(rays=4)


class Towards:
    """Everybody drives towards a place of its own in the world, without turning."""

    privileged = True

    def __init__(self, places, speed=0.5) -> None:
        self.places, self.speed = np.asarray(places, dtype=float), speed

    @property
    def description(self):
        return {"name": "towards"}

    def command(self, view: PrivilegedView) -> FloatArray:
        ahead = self.places - view.poses[..., :2]
        lengths = np.linalg.norm(ahead, axis=-1)
        angle = np.arctan2(ahead[..., 1], ahead[..., 0]) - view.poses[..., 2]
        speed = np.minimum(self.speed, lengths)
        return np.stack([speed * np.cos(angle), speed * np.sin(angle), np.zeros_like(angle)], axis=-1)


def look(poses, time=0.0, active=None) -> PrivilegedView:
    poses = np.asarray(poses, dtype=float)
    there = np.ones(poses.shape[:2], bool) if active is None else np.asarray(active)
    return PrivilegedView(Scan(np.full((*there.shape, 4), np.inf), CONFIG), there, time, poses)


def go(controller, poses, periods, period=0.1):
    """Poses at all times, shape (T, B, N, 3), of robots that take up every velocity at once and do not turn."""
    poses = np.array(poses, dtype=float)
    path = [poses.copy()]
    for step in range(periods):
        twists = controller.command(look(poses, step * period))
        cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
        poses[..., 0] += period * (cos * twists[..., 0] - sin * twists[..., 1])
        poses[..., 1] += period * (sin * twists[..., 0] + cos * twists[..., 1])
        path.append(poses.copy())
    return np.array(path)


def closest(path) -> float:
    """The smallest distance of two centres on straight ways between the records, by the foot of the perpendicular."""
    first, second = np.triu_indices(path.shape[2], 1)
    apart = path[:, :, first, :2] - path[:, :, second, :2]
    start, way = apart[:-1], apart[1:] - apart[:-1]
    share = -(start * way).sum(axis=-1) / np.maximum((way**2).sum(axis=-1), 1e-12)
    return float(np.linalg.norm(start + np.clip(share, 0, 1)[..., None] * way, axis=-1).min())


@settings(max_examples=15, deadline=None)
@given(
    angle=st.floats(-np.pi, np.pi),
    side=st.floats(0.01, 0.3),
    sign=st.sampled_from([-1, 1]),
    headings=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
)
def test_two_robots_that_head_at_each_other_pass(angle, side, sign, headings):
    along, across = np.array([np.cos(angle), np.sin(angle)]), sign * np.array([-np.sin(angle), np.cos(angle)])
    places = np.array([-1.5 * along, 1.5 * along + side * across])
    poses = np.column_stack([places, headings])[None]
    controller = Towards(places[None, ::-1])
    assert closest(go(controller, poses, 10 * 12)) < 2 * RADIUS
    path = go(OrcaFilter(controller, SETTINGS), poses, 10 * 25)
    assert closest(path) >= 2 * RADIUS - 1e-4
    np.testing.assert_allclose(path[-1, ..., :2], places[None, ::-1], atol=0.05)


def test_a_crowd_that_wants_to_one_place_does_not_touch():
    rng = np.random.default_rng(4)
    angles = np.arange(8) * np.pi / 4 + rng.uniform(-0.1, 0.1, (5, 8))
    poses = np.stack([1.5 * np.cos(angles), 1.5 * np.sin(angles), rng.uniform(-3, 3, (5, 8))], axis=-1)
    controller = Towards(np.zeros((5, 8, 2)))
    assert closest(go(controller, poses, 100)) < 0.1
    assert closest(go(OrcaFilter(controller, SETTINGS), poses, 100)) >= 2 * RADIUS - 1e-4


@settings(max_examples=50, deadline=None)
@given(twist=st.tuples(*3 * [st.floats(-2, 2)]), pose=st.tuples(*3 * [st.floats(-3, 3)]))
def test_a_lone_robot_does_as_it_likes(twist, pose):
    for limits in (SETTINGS, replace(SETTINGS, max_axis_speed=0.1)):
        filtered = OrcaFilter(Given([[twist]]), limits)
        for time in (0.0, 0.1):
            np.testing.assert_array_equal(filtered.command(look([[pose]], time)), [[twist]])


def test_robots_that_are_far_apart_and_robots_that_rest_do_as_they_like():
    far = SETTINGS.neighbour_distance
    poses = [[(0, 0, 0.3), (far, 0, 2.0)], [(0, 0, 0), (2 * RADIUS + 0.01, 0, 0)]]
    wanted = [[(0.5, 0, 0.1), (-0.5, 0.2, 0)], [(0, 0, 0), (0, 0, 1.0)]]
    np.testing.assert_array_equal(OrcaFilter(Given(wanted), SETTINGS).command(look(poses)), wanted)


@settings(max_examples=100, deadline=None)
@given(
    distance=st.floats(2 * RADIUS + 0.01, 1.5),
    angle=st.floats(-np.pi, np.pi),
    wanted=st.lists(st.floats(-0.35, 0.35), min_size=4, max_size=4),
)
def test_of_two_robots_at_rest_each_keeps_to_its_half_plane(distance, angle, wanted):
    """At rest the nearest relative velocity that touches within the horizon is straight ahead."""
    normal = np.array([np.cos(angle), np.sin(angle)])
    wishes = np.reshape(wanted, (2, 2))
    poses = [[(0, 0, 0), (*(distance * normal), 0)]]
    twists = np.concatenate([wishes, np.zeros((2, 1))], axis=1)[None]
    found = OrcaFilter(Given(twists), SETTINGS).command(look(poses))[0, :, :2]
    bound = (distance - 2 * RADIUS) / SETTINGS.time_horizon / 2
    for ahead, wish, velocity in zip((normal, -normal), wishes, found, strict=True):
        rules = [
            {"type": "ineq", "fun": lambda u, n=ahead: bound - n @ u},
            {"type": "ineq", "fun": lambda u: SETTINGS.max_speed**2 - u @ u},
        ]
        best = minimize(lambda u, w=wish: np.sum((u - w) ** 2), np.zeros(2), constraints=rules)
        np.testing.assert_allclose(velocity, best.x, atol=2e-3)
        assert ahead @ velocity <= bound + 1e-5


def test_turn_rates_pass_and_no_robot_is_faster_than_its_base():
    rng = np.random.default_rng(1)
    poses = np.concatenate([rng.uniform(-1.2, 1.2, (20, 6, 2)), rng.uniform(-3, 3, (20, 6, 1))], axis=-1)
    wanted = rng.uniform(-1, 1, (20, 6, 3))
    commands = OrcaFilter(Given(wanted), SETTINGS).command(look(poses))
    np.testing.assert_array_equal(commands[..., 2], wanted[..., 2])
    changed = (commands != wanted).any(axis=-1)
    assert changed.mean() > 0.5
    assert np.linalg.norm(commands[changed][:, :2], axis=-1).max() <= SETTINGS.max_speed + 1e-5


def test_the_order_of_robots_does_not_matter():
    rng = np.random.default_rng(2)
    poses = np.concatenate([rng.uniform(-1.5, 1.5, (10, 7, 2)), rng.uniform(-3, 3, (10, 7, 1))], axis=-1)
    moved = poses + np.concatenate([rng.uniform(-0.03, 0.03, (10, 7, 2)), np.zeros((10, 7, 1))], axis=-1)
    wanted = rng.uniform(-0.4, 0.4, (10, 7, 3))
    order = rng.permutation(7)
    one, other = OrcaFilter(Given(wanted), SETTINGS), OrcaFilter(Given(wanted[:, order]), SETTINGS)
    for time, seen in ((0.0, poses), (0.1, moved)):
        commands = one.command(look(seen, time))
        np.testing.assert_allclose(other.command(look(seen[:, order], time)), commands[:, order], atol=1e-4)
    assert (commands != wanted).any()


def test_worlds_do_not_depend_on_each_other():
    rng = np.random.default_rng(3)
    poses = np.concatenate([rng.uniform(-1, 1, (6, 5, 2)), np.zeros((6, 5, 1))], axis=-1)
    places = rng.uniform(-1, 1, (6, 5, 2))
    together = go(OrcaFilter(Towards(places), SETTINGS), poses, 20)
    for world in range(6):
        one = slice(world, world + 1)
        alone = go(OrcaFilter(Towards(places[one]), SETTINGS), poses[one], 20)
        np.testing.assert_array_equal(alone, together[:, one])


def test_robots_that_do_not_exist_take_no_part():
    poses = np.array([[(0, 0, 0), (0.5, 0, 0), (1.0, 0.1, 0)]], dtype=float)
    wanted = np.array([[(0.5, 0, 0), (0.4, 0.1, 0.2), (-0.5, 0, 0)]])
    gone = np.where(np.array([True, False, True])[:, None], poses, np.nan)
    some = OrcaFilter(Given(wanted), SETTINGS).command(look(gone, active=[[True, False, True]]))
    two = OrcaFilter(Given(wanted[:, [0, 2]]), SETTINGS).command(look(poses[:, [0, 2]]))
    np.testing.assert_array_equal(some[:, [0, 2]], two)
    assert not some[:, 1].any()
    assert (OrcaFilter(Given(wanted), SETTINGS).command(look(poses))[:, [0, 2]] != two).any()


def test_velocities_are_those_since_the_last_view_of_the_same_run():
    poses = np.array([[(0, 0, 0), (0.9, 0, 0)]], dtype=float)
    wanted = np.array([[(0.3, 0, 0), (-0.3, 0, 0)]])
    earlier = poses - [(0.04, 0.03, 0), (-0.04, 0, 0)]
    at_rest = OrcaFilter(Given(wanted), SETTINGS).command(look(poses))
    filtered = OrcaFilter(Given(wanted), SETTINGS)

    def after(before, first=0.0, then=0.1, active=None):
        filtered.command(look(before, first, active))
        return filtered.command(look(poses, then))

    assert (after(earlier) != at_rest).any()
    for same in (
        # Time goes back or stands; a robot is new in its place, or there for the first time; it was put where it is.
        after(earlier, 0.2),
        after(earlier, 0.1),
        after(np.where([[[True], [False]]], poses, np.nan), active=[[True, False]]),
        after(poses - [(0.5, 0, 0), (0, 0, 0)]),
    ):
        np.testing.assert_array_equal(same, at_rest)
    alone = OrcaFilter(Towards(np.zeros((1, 1, 2))), SETTINGS)
    alone.command(look(poses[:, :1]))
    alone.controller = Given(wanted)
    np.testing.assert_array_equal(alone.command(look(poses, 0.1)), at_rest)


@pytest.mark.parametrize("name", ["room-6", "pillars", "living-room"])
def test_robots_that_flee_touch_no_wall_and_no_pillar(name):
    arena = get_arena(name)
    profile = replace(IDEAL, footprint=Footprint.circle(0.3))
    angles = np.arange(8) * np.pi / 4 + 0.1
    poses = np.stack([np.cos(angles), np.sin(angles), angles], axis=-1)[None]
    controller = Towards(20 * poses[..., :2])
    touched = []
    for driver in (controller, OrcaFilter(controller, OrcaSettings(0.16), arena.walls, arena.pillars)):
        world = World(poses, profile, arena, [0])
        for _ in range(120):
            world.apply(driver.command(world.observe()), 0.1)
        touched.append(bool(world.hit_arena.any()))
    assert touched == [True, False]


def test_it_describes_itself_and_arrives_elsewhere():
    controller = OrcaFilter(make_controller("scan-pipeline"), SETTINGS, *_obstacles())
    described = json.loads(json.dumps(controller.description, allow_nan=False))
    assert described["name"] == "scan-pipeline"
    assert described["orca"] == {
        "radius": 0.2, "period": 0.1, "time_horizon": 1.0, "max_speed": 0.5, "max_axis_speed": None,
    }  # fmt: skip
    assert controller.privileged
    view = look([[(0.5, 0.1, 0), (0.9, 0.3, 0)]])
    wanted = Given([[(0.5, 0, 0), (-0.2, 0.3, 0)]])
    here = OrcaFilter(wanted, SETTINGS, *_obstacles())
    commands = here.command(view)
    for far in (pickle.loads(pickle.dumps(here)), copy.deepcopy(here)):
        np.testing.assert_array_equal(far.command(view), commands)


def _obstacles():
    return [[-1.0, 1.0, 2.0, 1.0]], [[1.5, 0.0, 0.2]]


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        ({"radius": 0.0}, "radius is 0.0 m"),
        ({"time_horizon": np.inf}, "time_horizon is inf s"),
        ({"period": -1.0}, "period is -1.0 s"),
        ({"max_speed": 0.0}, "max_speed is 0.0 m/s"),
        ({"max_axis_speed": -1.0}, "max_axis_speed is -1.0 m/s"),
        ({"max_speed": np.inf}, "needs a limit of speed"),
    ],
)
def test_impossible_settings_are_refused(bad, says):
    with pytest.raises(ConfigurationError, match=says):
        replace(SETTINGS, **bad)


def test_a_team_without_poses_is_refused():
    view = View(Scan(np.full((1, 1, 4), np.inf), CONFIG), np.ones((1, 1), bool), 0.0)
    with pytest.raises(TriformError, match="ORCA needs true poses"):
        OrcaFilter(Given(np.zeros((1, 1, 3))), SETTINGS).command(view)


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrvo", None)
    with pytest.raises(ConfigurationError, match=r"ORCA needs pyrvo.* pip install 'triform\[orca\]'"):
        Scenario(guard="orca").make_controller("expert")
    assert isinstance(Scenario().make_controller("expert"), SafetyFilter)


def test_robots_that_it_cannot_steer_are_refused():
    with pytest.raises(ConfigurationError, match="'turtlebot4' has a differential base, and guard 'orca' drives holo"):
        Scenario("turtlebot4", guard="orca").make_controller("expert")
    with pytest.raises(ConfigurationError, match="guard is 'orca', which steers robots of one profile alone"):
        Scenario("hardware:2 ideal:1", guard="orca").make_controller("expert")
    for bad in ("rvo", True, None, ["orca"]):
        with pytest.raises(ConfigurationError, match=r"guard is .*; allowed are filter, orca, none"):
            Scenario(guard=bad)


def test_discs_cover_the_robots_of_a_scenario_and_its_base():
    robot = Scenario("hardware", guard="orca", overrides=Overrides(footprint="engineer"))
    settings = robot.make_controller("expert").description["orca"]
    assert settings["radius"] == pytest.approx(np.hypot(0.205, 0.12) + 0.01)
    assert (settings["period"], settings["max_speed"], settings["max_axis_speed"]) == (0.125, 0.5, 0.1)


def test_it_belongs_to_the_scenario_whoever_steers():
    scenario = Scenario(guard="orca", arena="pillars", duration=10.0)
    starts = scenario.sample_starts(5, 4, 7)
    made = scenario.make_controller("scan-pipeline")
    assert scenario.make_controller(made) is made
    _, table = scenario.run(starts, made)
    assert not table["collision"].any()
    assert not table["hit_arena"].any()
    _, again = scenario.run(starts, "scan-pipeline")
    np.testing.assert_array_equal(table["formation_error"], again["formation_error"])


def test_a_robot_that_joins_is_avoided():
    scenario = Scenario(guard="orca", duration=12.0, event=Event.parse("join@5"))
    _, table = scenario.run(scenario.sample_starts(4, 3, 7), "expert")
    assert table["robots"].tolist() == [5, 5, 5]
    assert not table["collision"].any()
