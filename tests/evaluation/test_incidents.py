from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from tests.formations import hexagon
from triform.evaluation import Scenario, measure
from triform.evaluation.incidents import INCIDENTS, MEETING, incident_starts, push_out, run_incident
from triform.simulation import IDEAL, World, is_connected, sample_starts

SCENARIO = Scenario(controller="expert-odd", duration=12.0)
MOMENT, RUNS, SEED = 6.0, 4, 3


def drive(incident, robots=5, first=0, runs=RUNS, scenario=SCENARIO):
    poses = incident_starts(incident, scenario, robots, runs, SEED, first)
    indices = range(first, first + runs)
    return run_incident(scenario, incident, poses, indices, SEED, MOMENT, scenario.make_controller())


def size(incident):
    return sum(MEETING) if incident == "meet" else 5


@pytest.fixture(scope="module")
def runs():
    return {incident: drive(incident, size(incident)) for incident in INCIDENTS}


def test_a_stuck_robot_stays_and_the_others_move(runs):
    trajectory, _ = runs["stuck"]
    way = np.abs(np.diff(trajectory.positions, axis=1)).sum(axis=(1, 3))
    assert ((way == 0).sum(axis=1) == 1).all()
    assert len(set(np.argmin(way, axis=1))) > 1


def test_a_robot_that_leaves_is_gone_from_its_moment_on(runs):
    trajectory, table = runs["leaves"]
    counts = trajectory.active.sum(axis=-1)
    np.testing.assert_array_equal(counts, np.where(trajectory.time < MOMENT - 1e-6, 5, 4)[None].repeat(RUNS, axis=0))
    assert (table["robots"] == 4).all()


@pytest.mark.parametrize("distance", [0.6, 1.0, 1.5])
def test_teams_that_meet_are_linked_and_just_within_sight(distance):
    scenario = Scenario(controller="expert", distance=distance)
    poses = incident_starts("meet", scenario, 9, 30, SEED)
    for start in poses:
        those, others = start[: MEETING[0], :2], start[MEETING[0] :, :2]
        assert cdist(those, others).min() == pytest.approx(1.9 * distance)
        for team in (those, others):
            assert is_connected(np.ascontiguousarray(team), 2 * distance)
    np.testing.assert_allclose(poses[..., :2].mean(axis=1), 0, atol=1e-12)
    np.testing.assert_array_equal(incident_starts("meet", scenario, 9, 2, SEED, first=7), poses[7:9])


def test_other_incidents_begin_like_any_run():
    for incident in (None, "stuck", "leaves", "pushed"):
        np.testing.assert_array_equal(incident_starts(incident, SCENARIO, 6, 2, SEED, 1), sample_starts(6, 2, SEED, 1))


def test_a_pushed_robot_jumps_outwards_and_nobody_else_does(runs):
    trajectory, table = runs["pushed"]
    at = int(np.searchsorted(trajectory.time, MOMENT - 1e-6))
    jumps = np.linalg.norm(np.diff(trajectory.positions, axis=1), axis=-1)
    assert ((jumps > 0.6).sum(axis=(1, 2)) == 1).all()
    np.testing.assert_allclose(jumps[:, at - 1].max(axis=1), 0.7, atol=0.1)
    assert (table["robots"] == 5).all()


@pytest.mark.parametrize("distance", [0.6, 1.0])
def test_who_is_pushed_stays_within_sight_and_clear_of_others(distance):
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


def test_if_nobody_fits_the_outermost_is_pushed():
    world = World(np.array([[[0.1, 0.0, 0.0], [1.9, 0.0, 0.0], [-2.0, 0.0, 0.5]]]), IDEAL)
    assert push_out(world, 0, 1.0, np.random.default_rng(0)) == 2
    np.testing.assert_allclose(world.poses[0, 2], [-2.7, 0.0, 0.5])


def test_measures_begin_when_a_robot_leaves_or_is_pushed(runs):
    for incident, (trajectory, table) in runs.items():
        since = MOMENT if incident in ("leaves", "pushed") else 0.0
        expected = measure(trajectory.since(since))
        for name in ("strict", "success", "strict_time", "settled_speed", "converge_time", "formation_error"):
            np.testing.assert_array_equal(table[name], expected[name], err_msg=f"{incident}, {name}")


@pytest.mark.parametrize("incident", INCIDENTS)
def test_a_run_is_a_function_of_its_index_alone(runs, incident):
    _, alone = drive(incident, size(incident), first=2, runs=1)
    for name, column in runs[incident][1].items():
        np.testing.assert_array_equal(column[2:3], alone[name], err_msg=name)
