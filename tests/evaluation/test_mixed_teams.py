"""Runs of mixed teams: controllers and safety filters of each kind, commands held, results described."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from triform.control import ControllerSpec, MixedController, SafetyFilter, drive, make_controller
from triform.evaluation import Scenario
from triform.evaluation.events import Event
from triform.evaluation.filters import team_settings
from triform.evaluation.overrides import Overrides
from triform.evaluation.scenario import Guard
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.experiments.settings import describe
from triform.mixed import MixedView
from triform.simulation import HARDWARE, IDEAL, PROFILES, Composition, Footprint, Profile, World, profile_toml
from triform.types import ConfigurationError, FloatArray, TriformError, View

MIXED = "hardware:2 turtlebot4:2 turtlebot3-burger:1"
BURGER, TURTLEBOT4 = PROFILES["turtlebot3-burger"], PROFILES["turtlebot4"]


def _view(scenario: Scenario, seconds: float = 1.0) -> MixedView:
    """What a mixed team senses while it stands; all kinds are due."""
    world = scenario.make_world(scenario.sample_starts(5, 2, 5), [np.random.SeedSequence(run) for run in (1, 2)])
    world.apply(np.zeros((2, 5, 3)), seconds)
    view = world.observe()
    assert isinstance(view, MixedView)
    assert all(view.due)
    return view


def test_each_kind_is_steered_as_a_team_of_its_own_with_its_scans() -> None:
    scenario = Scenario(MIXED, guard="none")
    view = _view(scenario)
    for name in ("policy", "scan-pipeline"):
        commands = scenario.make_controller(name).command(view)
        for profile, part, robots in zip(scenario.team.profiles, view.parts, view.robots, strict=True):
            alone = make_controller(name, footprint=profile.footprint.size, noise=profile.lidar.largest_noise)
            np.testing.assert_array_equal(commands[:, robots], alone.command(part))


def test_each_kind_has_the_threshold_of_its_own_lidar() -> None:
    bright = Overrides(min_intensity=150.0)
    scenario = Scenario("hardware:2 ideal:3", arena="pillars", overrides=bright)
    view = _view(scenario, 1.0)
    controller = scenario.make_controller("scan-pipeline")
    description = controller.description["kinds"]
    assert [kind["min_intensity"] for kind in description] == [150.0, 150.0]
    for part in view.parts:
        assert part.scans.intensities is not None
    assert np.isfinite(controller.command(view)).all()
    assert scenario.make_controller(controller) is controller
    # One that sees all poses of the team sees no scans.
    assert np.isfinite(scenario.make_controller("triangulating").command(view)).all()


def test_a_mixed_team_with_tape_forms_up_among_pillars() -> None:
    scenario = Scenario("hardware:3 turtlebot3-burger:2", "pillars", overrides=Overrides(min_intensity=230.0))
    _, table = scenario.run(scenario.sample_starts(5, 1, 5), "policy")
    assert table["success"].all()
    assert not table["collision"].any()
    assert not table["hit_arena"].any()


def test_a_lidar_without_intensities_is_named() -> None:
    with pytest.raises(ConfigurationError, match="LiDAR of the profile 'turtlebot4' does not say how bright"):
        Scenario("hardware:2 turtlebot4:3", overrides=Overrides(min_intensity=230.0))


@pytest.mark.parametrize("guard", ["filter", "none"])
def test_a_made_controller_stays_as_it_is_and_runs_like_its_name(guard: Guard) -> None:
    bright = Overrides(min_intensity=150.0)
    scenario = Scenario("hardware:2 ideal:1", duration=5.0, guard=guard, overrides=bright)
    made = scenario.make_controller("scan-pipeline")
    assert scenario.make_controller(made) is made
    starts = scenario.sample_starts(3, 1, 7)
    run, again = (scenario.run(starts, each)[0] for each in (made, "scan-pipeline"))
    np.testing.assert_array_equal(run.poses, again.poses)


def test_a_kind_may_lose_its_last_robot() -> None:
    event = Event.parse("leave@5")
    for profile, lost in (("turtlebot4:1 hardware:1", {0, 1}), ("turtlebot3-burger:1", {0})):
        scenario = Scenario(profile, duration=10.0, event=event)
        runs = 4
        _, table = scenario.run(scenario.sample_starts(len(lost), runs, 7), "scan-pipeline")
        assert set(table["changed_robot"].tolist()) == lost
        assert table["robots"].tolist() == [len(lost) - 1] * runs


@pytest.mark.parametrize("name", ["triangulating", "gnn"])
def test_a_privileged_controller_sees_everybody_and_each_kind_its_own_filter(name: str) -> None:
    scenario = Scenario(MIXED)
    view = _view(scenario)
    everyone = make_controller(name, footprint=HARDWARE.footprint.size)
    controller = scenario.make_controller(name)
    assert controller.privileged
    wanted, commands = everyone.command(view), controller.command(view)
    settings = team_settings(scenario.driven)
    for rules, part, robots in zip(settings, view.parts, view.robots, strict=True):
        own = SafetyFilter(everyone, rules).limit(part, wanted[:, robots])
        np.testing.assert_array_equal(commands[:, robots], own)
    # Differential bases get what wheels can do.
    assert (commands[:, 2:, 1] == 0).all()
    assert (commands[:, :2, 1] != 0).any()


def test_who_is_not_due_holds_what_it_was_commanded() -> None:
    scenario = Scenario(MIXED)
    view = _view(scenario)
    held = np.random.default_rng(1).normal(size=(2, 5, 3))
    later = MixedView(view.parts, [False, True, False], held)
    commands = scenario.make_controller("scan-pipeline").command(later)
    np.testing.assert_array_equal(commands[:, [0, 1, 4]], held[:, [0, 1, 4]])
    assert not np.isclose(commands[:, 2:4], held[:, 2:4]).any()


def test_a_controller_that_knows_no_kinds_commands_nothing() -> None:
    scenario = Scenario(MIXED)
    view = _view(scenario)
    for name in ("policy", "scan-pipeline"):
        with pytest.raises(TriformError, match="no common scans"):
            make_controller(name).command(view)
    controller = scenario.make_controller("scan-pipeline")
    with pytest.raises(TriformError, match="made for robots of 3 profiles"):
        controller.command(MixedView(view.parts[:2], view.due[:2], view.held[:, :4]))
    with pytest.raises(TriformError, match="made for robots of 3 profiles"):
        controller.command(view.parts[0])


class _Careless:
    """Drives forward whatever it sees, and notes what that is."""

    privileged = False
    description: ClassVar[dict[str, Any]] = {"name": "careless"}

    def __init__(self) -> None:
        self.seen: list[View] = []

    def command(self, view: View) -> FloatArray:
        self.seen.append(view)
        return np.full((*view.active.shape, 3), 0.3)


def test_a_controller_of_ones_own_sees_each_kind_at_its_own_period() -> None:
    scenario, own = Scenario("hardware:1 turtlebot4:2", duration=5.0), _Careless()
    own.seen = []
    scenario.run(np.array([[[0.0, 0, 0], [0, 1, 0], [0, 2, 0]]]), own)
    robots = [view.active.shape[1] for view in own.seen]
    assert (robots.count(1), robots.count(2)) == (40, 50)
    assert {view.scans.config.rays for view in own.seen if view.active.shape[1] == 1} == {667}


def test_all_filters_of_a_team_rest_on_its_slowest_reaction() -> None:
    settings = team_settings((HARDWARE, BURGER))
    alone = [team_settings((each,))[0] for each in (HARDWARE, BURGER)]
    slowest = max(rules.reaction for rules in alone)
    assert {rules.reaction for rules in settings} == {slowest}
    for rules, own in zip(settings, alone, strict=True):
        assert replace(rules, reaction=own.reaction) == own
    # A box that may turn, 0.5 m x 0.3 m: others keep away from the circle around it, which is 0.14 m wider.
    turning = replace(BURGER, footprint=Footprint.box(0.5, 0.3))
    both = team_settings((HARDWARE, turning))
    stands_out = np.hypot(0.25, 0.15) - 0.15
    assert both[0].min_gap == pytest.approx(alone[0].min_gap + stands_out)
    assert both[1].min_gap == alone[1].min_gap


@pytest.mark.parametrize("pair", [(HARDWARE, BURGER), (TURTLEBOT4, IDEAL), (BURGER, PROFILES["rosbot-xl"])])
def test_robots_of_two_kinds_that_drive_at_each_other_do_not_meet(
    pair: tuple[Profile, Profile], tmp_path: Path
) -> None:
    for number, profile in enumerate(pair):
        (tmp_path / f"{number}.toml").write_text(profile_toml(profile), encoding="utf-8")
    scenario = Scenario(f"{tmp_path}/0.toml:1 {tmp_path}/1.toml:1")
    assert scenario.team.profiles[0].footprint == pair[0].footprint
    poses = np.array([[[-0.7, 0.02 * run, 0.2], [0.7, 0, np.pi - 0.1 * run]] for run in range(8)])
    world = World(poses, scenario.team, seeds=range(8))

    class _Collide(_Careless):
        def command(self, view: View) -> FloatArray:
            commands = np.zeros((8, 1, 3))
            commands[..., 0] = 0.5
            return commands

    drive(world, scenario.make_controller(_Collide()), 10.0)
    assert not world.collided.any()
    assert (world.min_distance < 0.9).any()


def test_a_mixed_team_forms_up_and_its_record_is_what_was_driven() -> None:
    scenario = Scenario(MIXED, duration=40.0)
    trajectory, table = scenario.run(scenario.sample_starts(5, 2, 5), "policy", seed=5)
    assert table["strict"].all()
    assert not table["collision"].any()
    assert trajectory.period == pytest.approx(1 / 40)
    # Commands change at each kind's own period alone.
    for robot, ticks in ((0, 5), (2, 4), (4, 4)):
        changes = np.flatnonzero(np.any(np.diff(trajectory.commands[0, :, robot], axis=0) != 0, axis=-1)) + 1
        assert len(changes) > 20
        assert (changes % ticks == 0).all()


def test_events_go_with_mixed_teams() -> None:
    scenario = Scenario("ideal:2 turtlebot4:2", duration=12.0, event=Event("join", 6.0))
    trajectory, table = scenario.run(scenario.sample_starts(4, 1, 5), "triangulating", seed=5)
    assert trajectory.poses.shape[2] == 5
    assert table["changed_robot"].tolist() == [4]
    # The newcomer is of the last kind: it has wheels.
    assert (trajectory.commands[..., 4, 1] == 0).all()
    assert np.any(trajectory.commands[..., 4, 0] != 0)


def test_results_do_not_depend_on_threads_batch_or_the_controllers_way() -> None:
    scenario = Scenario("ideal:1 turtlebot4:2", duration=5.0)
    poses = scenario.sample_starts(3, 4, 5)
    controller = scenario.make_controller("scan-triangulating")
    assert isinstance(controller, MixedController)
    whole, _ = scenario.run(poses, controller, seed=5)
    for way in (pickle.loads(pickle.dumps(controller)), copy.deepcopy(controller)):
        alone, _ = scenario.run(poses[2:3], way, seed=5, indices=[2])
        np.testing.assert_array_equal(alone.poses, whole.poses[2:3])


def test_results_describe_each_kind() -> None:
    scenario = Scenario(MIXED)
    described = describe(scenario, scenario.make_controller("scan-pipeline"))
    assert described["profile"] == MIXED
    kinds = described["profile_description"]
    assert [(kind["robots"], kind["name"]) for kind in kinds] == [
        (2, "hardware"), (2, "turtlebot4"), (1, "turtlebot3-burger"),
    ]  # fmt: skip
    outlines = [kind["guard"]["footprint"]["length"] for kind in described["controller_description"]["kinds"]]
    assert outlines == [0.32, 0.342, 0.25]
    single = Scenario("turtlebot4:3")
    assert describe(single, single.make_controller("scan-pipeline"))["profile_description"]["name"] == "turtlebot4"


def test_what_a_mixed_team_cannot_do_is_said() -> None:
    assert EvaluateConfig(scenario=Scenario(MIXED)).robots == (5,)
    assert EvaluateConfig(scenario=Scenario("turtlebot4:3")).robots == (3,)
    with pytest.raises(ConfigurationError, match="the profiles have 5 robots"):
        EvaluateConfig(robots=(5, 9), scenario=Scenario(MIXED))
    for simulator in ("mujoco", "gazebo"):
        with pytest.raises(ConfigurationError, match="in the built-in world alone"):
            Scenario(MIXED, simulator=simulator)
    with pytest.raises(ConfigurationError, match="this works with one"):
        _ = Scenario(MIXED).robot
    with pytest.raises(ConfigurationError, match="the profiles have 5 robots"):
        Scenario(MIXED).run(np.zeros((1, 6, 3)), "triangulating")
    assert Scenario(MIXED).of_first_kind.robot == Scenario("hardware").robot


def test_an_evaluation_of_a_mixed_team() -> None:
    scenario = Scenario("ideal:2 turtlebot3-burger:2", duration=5.0)
    found = evaluate(EvaluateConfig(ControllerSpec("triangulating"), runs=2, scenario=scenario))
    assert found.results[0]["robots"] == 4
    assert tuple(found.config["robots"]) == (4,)
    assert Composition.parse(found.config["profile"]) == Composition(
        (PROFILES["ideal"], PROFILES["turtlebot3-burger"]), (2, 2)
    )
