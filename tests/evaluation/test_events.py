from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from tests.formations import hexagon
from triform.evaluation import Scenario, Trajectory, measure
from triform.evaluation.events import EVENT_TIME, EVENTS, MEETING, Event, push_out
from triform.report.results import summarise_event
from triform.simulation import IDEAL, World, is_connected, sample_starts
from triform.types import ConfigurationError

MOMENT, RUNS, SEED = 6.0, 4, 3


def drive(kind, robots=5, first=0, runs=RUNS, distance=1.0, controller="expert-odd"):
    scenario = Scenario(duration=12.0, event=Event(kind, MOMENT), distance=distance)
    poses = scenario.sample_starts(robots, runs, SEED, first)
    return scenario.run(poses, controller, SEED, range(first, first + runs))


def size(kind):
    return sum(MEETING) if kind == "meet" else 5


@pytest.fixture(scope="module")
def runs():
    return {kind: drive(kind, size(kind)) for kind in EVENTS}


def test_a_stuck_robot_stays_and_the_others_move(runs):
    trajectory, _ = runs["stuck"]
    way = np.abs(np.diff(trajectory.positions, axis=1)).sum(axis=(1, 3))
    assert ((way == 0).sum(axis=1) == 1).all()
    assert len(set(np.argmin(way, axis=1))) > 1


def test_a_robot_that_joins_appears_at_its_moment_near_the_others(runs):
    trajectory, table = runs["join"]
    counts = trajectory.active.sum(axis=-1)
    np.testing.assert_array_equal(counts, np.where(trajectory.time < MOMENT - 1e-6, 5, 6)[None].repeat(RUNS, axis=0))
    at = int(np.searchsorted(trajectory.time, MOMENT - 1e-6))
    for run, robot in enumerate(table["changed_robot"]):
        apart = np.linalg.norm(trajectory.positions[run, at] - trajectory.positions[run, at, robot], axis=-1)
        assert 0.5 <= np.delete(apart, robot).min() <= 2.0


@pytest.mark.parametrize("distance", [0.6, 1.5])
def test_a_robot_that_joins_keeps_the_prescribed_distance(distance):
    trajectory, table = drive("join", 3, distance=distance, controller="scan-pipeline")
    at = int(np.searchsorted(trajectory.time, MOMENT - 1e-6))
    for run, robot in enumerate(table["changed_robot"]):
        apart = np.linalg.norm(trajectory.positions[run, at] - trajectory.positions[run, at, robot], axis=-1)
        assert max(0.5, 0.5 * distance) <= np.delete(apart, robot).min() <= 2.0 * distance


def test_a_robot_that_leaves_is_gone_from_its_moment_on(runs):
    trajectory, table = runs["leave"]
    for run, robot in enumerate(table["changed_robot"]):
        present = trajectory.active[run, :, robot]
        np.testing.assert_array_equal(present, trajectory.time < MOMENT - 1e-6)
        assert np.isnan(trajectory.poses[run, ~present, robot]).all()
    assert len(set(table["changed_robot"])) > 1
    assert (table["robots"] == 4).all()
    assert np.nanmax(np.linalg.norm(np.diff(trajectory.positions, axis=1), axis=-1)) <= 0.05 + 1e-9


@pytest.mark.parametrize("distance", [0.6, 1.0, 1.5])
def test_teams_that_meet_are_connected_and_just_within_sight(distance):
    scenario = Scenario(distance=distance, event=Event("meet"))
    poses = scenario.sample_starts(9, 30, SEED)
    for start in poses:
        those, others = start[: MEETING[0], :2], start[MEETING[0] :, :2]
        assert cdist(those, others).min() == pytest.approx(1.9 * distance)
        for team in (those, others):
            assert is_connected(np.ascontiguousarray(team), 2 * distance)
    np.testing.assert_allclose(poses[..., :2].mean(axis=1), 0, atol=1e-12)
    np.testing.assert_array_equal(scenario.sample_starts(9, 2, SEED, first=7), poses[7:9])
    with pytest.raises(ConfigurationError, match="teams of 4 and 5, 9 robots"):
        scenario.sample_starts(8, 1, SEED)


def test_other_events_begin_like_any_run():
    for kind in ("join", "leave", "push", "stuck"):
        poses = Scenario(event=Event(kind)).sample_starts(6, 2, SEED, 1)
        np.testing.assert_array_equal(poses, sample_starts(6, 2, SEED, 1))


def test_a_pushed_robot_jumps_outwards_and_no_other_does(runs):
    trajectory, table = runs["push"]
    at = int(np.searchsorted(trajectory.time, MOMENT - 1e-6))
    jumps = np.linalg.norm(np.diff(trajectory.positions, axis=1), axis=-1)
    assert ((jumps > 0.6).sum(axis=(1, 2)) == 1).all()
    np.testing.assert_allclose(jumps[:, at - 1].max(axis=1), 0.7, atol=0.1)
    assert (table["robots"] == 5).all()


@pytest.mark.parametrize("distance", [0.6, 1.0])
def test_a_pushed_robot_stays_within_sight_and_clear_of_others(distance):
    pushed = set()
    for seed in range(20):
        poses = np.concatenate([hexagon(distance), np.zeros((7, 1))], axis=1)[None]
        world = World(poses, IDEAL)
        robot = push_out(world, 0, distance, np.random.default_rng(seed))
        pushed.add(robot)
        after = world.poses[0]
        assert np.linalg.norm(after[robot, :2] - poses[0, robot, :2]) == pytest.approx(0.7 * distance)
        # From the ring, straight away from the centre.
        assert np.linalg.norm(after[robot, :2]) == pytest.approx(1.7 * distance)
        np.testing.assert_array_equal(np.delete(after, robot, axis=0), np.delete(poses[0], robot, axis=0))
        assert world.active.all()
    assert len(pushed) > 3
    assert 0 not in pushed


def test_if_no_robot_fits_the_outermost_is_pushed():
    world = World(np.array([[[0.1, 0.0, 0.0], [1.9, 0.0, 0.0], [-2.0, 0.0, 0.5]]]), IDEAL)
    assert push_out(world, 0, 1.0, np.random.default_rng(0)) == 2
    np.testing.assert_allclose(world.poses[0, 2], [-2.7, 0.0, 0.5])


def test_measures_begin_when_a_robot_joins_leaves_or_is_pushed(runs):
    for kind, (trajectory, table) in runs.items():
        since = MOMENT if Event(kind).interrupts else 0.0
        expected = measure(trajectory.since(since))
        for name in ("strict", "success", "strict_time", "settled_speed", "converge_time", "formation_error"):
            np.testing.assert_array_equal(table[name], expected[name], err_msg=f"{kind}, {name}")


@pytest.mark.parametrize("kind", EVENTS)
def test_a_run_is_a_function_of_its_index_alone(runs, kind):
    _, alone = drive(kind, size(kind), first=2, runs=1)
    for name, column in runs[kind][1].items():
        np.testing.assert_array_equal(column[2:3], alone[name], err_msg=name)


def test_recovery_is_measured_on_the_team_after_the_event(runs):
    trajectory, table = runs["join"]
    summary = summarise_event(table)
    assert (summary["robots_before"], summary["robots_after"]) == (5, 6)
    assert summary["recovered"] == np.mean(table["success"])
    np.testing.assert_array_equal(np.isfinite(table["recovery_time"]), table["success"])
    np.testing.assert_array_equal(table["strict_recovery_time"], table["strict_time"] - MOMENT)
    np.testing.assert_array_equal(table["strict_before"], measure(_until(trajectory, MOMENT))["strict"])
    assert len(trajectory.poses) == summary["runs"] == RUNS


def _until(trajectory, time):
    """The records before ``time``, and the earlier team at ``time``, in which no robot had moved since."""
    last = int(np.searchsorted(trajectory.time, time - 1e-6))
    earlier = trajectory.active[:, last - 1, :, None]
    poses = trajectory.poses[:, : last + 1].copy()
    poses[:, last] = np.where(earlier, poses[:, last], np.nan)
    active = trajectory.active[:, : last + 1].copy()
    active[:, last] = earlier[..., 0]
    return Trajectory(trajectory.time[: last + 1], poses, active, trajectory.commands[:, :last])


def test_runs_torn_apart_by_the_event_are_counted_apart(runs):
    table = {name: column.copy() for name, column in runs["leave"][1].items()}
    table["success"][:] = [True, True, False, False]
    table["connected_start"][:] = [True, True, True, False]
    summary = summarise_event(table)
    assert summary["recovered"] == 0.5
    assert summary["connected"] == 0.75
    assert summary["recovered_connected"] == pytest.approx(2 / 3)


@given(st.sampled_from(EVENTS), st.one_of(st.just(EVENT_TIME), st.floats(0.1, 1e4).map(lambda time: round(time, 2))))
def test_an_event_is_read_as_it_is_spelled(kind, time):
    event = Event(kind, time)
    assert Event.parse(event.label) == (event if event.interrupts else Event(kind))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("explode", "event is 'explode'; allowed are join, leave, push, stuck, meet"),
        ("join@soon", "event 'join@soon' has no time after the @; write seconds, as in join@15"),
        ("join@-1", "event time is -1.0 s; it must be positive"),
        ("join@nan", "event time is nan s"),
    ],
)
def test_a_bad_event_is_refused_in_a_sentence(text, says):
    with pytest.raises(ConfigurationError, match=says):
        Event.parse(text)


@pytest.mark.parametrize("time", [4.9, 35.1])
def test_an_event_leaves_time_to_measure(time):
    with pytest.raises(ConfigurationError, match=f"the event comes at {time} s"):
        Scenario(event=Event("leave", time))
