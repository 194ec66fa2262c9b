"""Fresh demonstrations: what is drawn, and that labels and truth belong together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.control import Teacher, expert_variant
from triform.dataset import COLUMNS, FreshBatch, StateConfig, draw_fresh, neighbours
from triform.geometry import body_to_world, gabriel_graph
from triform.types import ConfigurationError, MapConfig, ScanConfig


def draw(seed: int, teacher: str = "expert-odd", **states: object) -> FreshBatch:
    rng = np.random.default_rng(seed)
    return draw_fresh(rng, 40, Teacher(teacher), StateConfig(**states), ScanConfig(), MapConfig())


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["expert", "expert-sensed", "expert-odd"]))
def test_commands_are_the_teachers_sum_over_the_neighbours(seed: int, teacher: str) -> None:
    batch = draw(seed, teacher)
    place, terms, edge = batch.neighbours[..., :2], batch.neighbours[..., 2:4], batch.neighbours[..., 4:5]
    length = np.linalg.norm(place, axis=-1, keepdims=True)
    pull = edge * (length - 1) / np.maximum(length, 1e-12) * place
    wanted = pull + expert_variant(teacher).odd_gain * np.stack([-pull[..., 1], pull[..., 0]], axis=-1)
    np.testing.assert_allclose(terms, wanted, atol=1e-8)
    total = wanted.sum(axis=1)
    speed = np.linalg.norm(total, axis=-1, keepdims=True)
    expected = total / np.maximum(speed, 1.0)
    np.testing.assert_allclose(batch.commands[:, :2], expected, atol=1e-9)
    assert not batch.commands[:, 2].any()
    assert (length[edge == 1] <= expert_variant(teacher).sensing_range).all()


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_every_occupied_cell_belongs_to_a_robot(seed: int) -> None:
    config = MapConfig()
    batch = draw(seed, robots=(5,))
    map_index, row, column = np.nonzero(batch.maps)
    cells = (np.stack([row, column], axis=1) + 0.5) * config.cell - config.half_extent
    gap = np.linalg.norm(batch.neighbours[map_index, :, :2] - cells[:, None], axis=-1).min(axis=1)
    # Half a footprint's diagonal is 0.2 m; projection and dilation add less than two cells.
    assert gap.max() < 0.2 + 2 * np.sqrt(2) * config.cell


def test_placements_keep_their_distance_and_settled_states_are_near_rest() -> None:
    bare = draw(1, robots=(7,), moved=0.0, settled=0.0)
    assert np.linalg.norm(bare.neighbours[..., :2], axis=-1).min() >= 0.45
    settled = draw(1, robots=(7,), moved=0.0, settled=1.0, settled_jitter=(0.0,), settled_time=200.0)
    assert np.median(np.linalg.norm(settled.commands, axis=1)) < 0.01
    assert np.median(np.linalg.norm(bare.commands, axis=1)) > 0.1


def test_a_batch_has_one_team_size_of_those_allowed() -> None:
    sizes = {draw(seed, robots=(3, 5)).neighbours.shape[1] + 1 for seed in range(20)}
    assert sizes == {3, 5}
    alone = draw(0, robots=(1,))
    assert not alone.maps.any()
    assert not alone.commands.any()


def test_the_same_generator_draws_the_same_batch() -> None:
    first, second, other = draw(3), draw(3), draw(4)
    np.testing.assert_array_equal(first.maps, second.maps)
    np.testing.assert_array_equal(first.commands, second.commands)
    assert first.maps.shape != other.maps.shape or not np.array_equal(first.maps, other.maps)


@pytest.mark.parametrize("name", ["expert", "expert-sensed", "expert-odd"])
def test_neighbours_are_the_others_seen_from_each_robot(name: str) -> None:
    rng = np.random.default_rng(0)
    poses = np.concatenate([rng.uniform(0, 4, (6, 5, 2)), rng.uniform(-3, 3, (6, 5, 1))], axis=-1)
    teacher = Teacher(name, distance=1.2)
    around = neighbours(poses, teacher)
    assert around.shape == (30, 4, COLUMNS)
    around = around.reshape(6, 5, 4, COLUMNS)
    graph = gabriel_graph(poses[..., :2], teacher.variant.sensing_range)
    for e in range(6):
        for i in range(5):
            others = [j for j in range(5) if j != i]
            expected = body_to_world(poses[e, others, :2] - poses[e, i, :2], -poses[e, i, 2])
            np.testing.assert_allclose(around[e, i, :, :2], expected, atol=1e-12)
            linked = graph[e, i, others]
            length = np.linalg.norm(expected, axis=1, keepdims=True)
            pull = np.where(linked[:, None], (length - 1.2) / length, 0.0) * expected
            term = pull + teacher.variant.odd_gain * np.stack([-pull[:, 1], pull[:, 0]], axis=1)
            np.testing.assert_allclose(around[e, i, :, 2:4], term, atol=1e-8)
            np.testing.assert_array_equal(around[e, i, :, 4], linked)
            shared = [(graph[e, i] & graph[e, j]).any() for j in others]
            np.testing.assert_array_equal(around[e, i, :, 5], shared)


@pytest.mark.parametrize(
    ("states", "says"),
    [
        ({"robots": ()}, "team sizes"),
        ({"robots": (0,)}, "team sizes"),
        ({"moved": 0.8, "settled": 0.3}, "shares"),
        ({"side": 0.0}, "side"),
        ({"moved_jitter": ()}, "moved_jitter"),
        ({"settled_jitter": (-1.0,)}, "settled_jitter"),
        ({"robots": (60,)}, "do not fit"),
    ],
)
def test_impossible_states_are_refused(states: dict, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        StateConfig(**states)
