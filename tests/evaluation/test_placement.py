from __future__ import annotations

import re

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.evaluation import Scenario
from triform.evaluation.events import Event
from triform.evaluation.placement import blocked_starts, sample_clear_addition, walled_off
from triform.simulation import Arena, World, get_arena, get_profile, sample_addition, sample_starts, world_seeds
from triform.types import ConfigurationError, TriformError

ROOM = get_arena("room-6")
NUMBERS = st.floats(-4, 4, allow_nan=False)
POINTS = st.tuples(NUMBERS, NUMBERS)


def world(*teams, arena=ROOM):
    return World(np.array(teams, dtype=float), get_profile("ideal"), arena)


@given(first=POINTS, second=POINTS, walls=st.lists(st.tuples(POINTS, POINTS), min_size=1, max_size=3))
@settings(deadline=None, max_examples=200)
def test_walls_between_points_are_found_as_shapely_finds_them(first, second, walls):
    kept = [wall for wall in walls if np.hypot(*np.subtract(*wall)) > 1e-3]
    arena = Arena(walls=np.reshape(kept, (-1, 4)))
    line = shapely.LineString([first, second])
    found = bool(walled_off(np.array(first), np.array(second), arena))
    near = [line.distance(shapely.Point(point)) for wall in kept for point in wall]
    near += [shapely.LineString(wall).distance(shapely.Point(point)) for wall in kept for point in (first, second)]
    if line.length > 1e-6 and min(near, default=1.0) > 1e-6:
        assert found == any(line.intersects(shapely.LineString(wall)) for wall in kept)


def test_no_way_out_of_a_room_slips_through_its_corner():
    assert walled_off(np.array([2.0, 2.0]), np.array([4.0, 4.0]), ROOM)
    assert not walled_off(np.array([2.0, 2.0]), np.array([-2.9, 2.9]), ROOM)
    assert not walled_off(np.array([2.0, 2.0]), np.array([4.0, 4.0]), Arena.open())


def test_blocked_are_starts_that_touch_or_stand_on_both_sides_of_a_wall():
    inside, touching, outside = [0.0, 0.0, 0.0], [2.9, 0.0, 0.0], [3.5, 0.0, 0.0]
    teams = world([inside, [1.0, 0.0, 0.0]], [inside, touching], [[2.0, 0.0, 0.0], outside])
    assert blocked_starts(teams).tolist() == [False, True, True]
    pillar = world([inside, [3.1, 3.1, 0.0]], arena=get_arena("pillars"))
    assert blocked_starts(pillar).tolist() == [True]


@pytest.mark.parametrize("check", ["check_starts", "make_world"])
def test_blocked_starts_are_counted_in_one_sentence(check):
    scenario = Scenario(arena="room-6")
    poses = np.zeros((3, 2, 3))
    poses[:, 1, 0] = [1.0, 2.9, 3.5]
    given = [poses] if check == "check_starts" else [poses, world_seeds(2, 0, range(3))]
    with pytest.raises(ConfigurationError, match=r"^2 of 3 starts of 2 robots touch an obstacle of [^\n]+$"):
        getattr(scenario, check)(*given)
    getattr(Scenario(), check)(*given)


@pytest.mark.parametrize("arena", ["open", "room-6", "pillars", "living-room"])
def test_starts_of_up_to_thirteen_robots_fit_into_every_arena(arena):
    for robots in (4, 13):
        Scenario(arena=arena, profile="hardware").check_starts(sample_starts(robots, 50, 7))


def test_a_robot_joins_inside_the_room_and_clear_of_everything():
    corner = [[2.5, 2.5, 0.0], [1.7, 2.6, 0.0]]
    teams = world(*[corner] * 60)
    naive = [sample_addition(teams.poses[0], teams.active[0], np.random.default_rng(seed)) for seed in range(60)]
    assert any((np.abs(pose[:2]) > 3).any() for pose in naive)
    for index in range(60):
        pose = sample_clear_addition(teams, index, np.random.default_rng(index))
        assert (np.abs(pose[:2]) < 3).all()
        teams.add_robot(index, pose)
    assert not teams.hit_arena.any()
    assert not teams.collided.any()
    assert (teams.min_distance >= 0.5).all()


def test_the_open_plane_leaves_the_place_of_a_robot_that_joins_as_it_was():
    teams = world([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], arena=Arena.open())
    expected = sample_addition(teams.poses[0], teams.active[0], np.random.default_rng(5))
    np.testing.assert_array_equal(sample_clear_addition(teams, 0, np.random.default_rng(5)), expected)


def test_a_room_without_a_place_is_named():
    cell = world([[0.0, 0.0, 0.0]], arena=Arena.room(0.8, 0.8, name="cell"))
    with pytest.raises(TriformError, match=re.escape("no place for a new robot in the arena 'cell'")):
        sample_clear_addition(cell, 0, np.random.default_rng(0))


def test_teams_that_change_in_a_room_stay_in_it():
    scenario = Scenario(duration=10.0, arena="room-6", event=Event("join", 5.0))
    trajectory, table = scenario.run(scenario.sample_starts(4, 12, 2), "expert", seed=2)
    added = trajectory.positions[np.arange(12), 50, table["changed_robot"]]
    assert (np.abs(added) < 3).all()
    with pytest.raises(ConfigurationError, match="of 12 starts of 25 robots touch"):
        scenario.run(scenario.sample_starts(25, 12, 7), "expert")
