from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial import Delaunay

from triform.geometry import gabriel_graph
from triform.types import ConfigurationError

# Multiples of 1/8 make every product exact, so ties on circles are decided exactly.
grid_points = hnp.arrays(np.int64, st.tuples(st.integers(1, 8), st.just(2)), elements=st.integers(-12, 12)).map(
    lambda a: a / 8.0
)


def by_definition(points: np.ndarray, max_range: float = np.inf) -> np.ndarray:
    """Edge iff no other robot is nearer to the midpoint than half the pair's distance, O(N^3)."""
    robots = len(points)
    graph = np.zeros((robots, robots), dtype=bool)
    for i in range(robots):
        for j in range(robots):
            if i == j or np.sum((points[i] - points[j]) ** 2) > max_range**2:
                continue
            middle = (points[i] + points[j]) / 2
            inside = np.sum((points - middle) ** 2, axis=1) < np.sum((points[i] - points[j]) ** 2) / 4
            inside[[i, j]] = False
            graph[i, j] = not inside.any()
    return graph


@settings(deadline=None, max_examples=200)
@given(grid_points)
def test_agrees_with_the_definition_with_ties(points: np.ndarray) -> None:
    np.testing.assert_array_equal(gabriel_graph(points), by_definition(points))


@settings(deadline=None, max_examples=100)
@given(grid_points, st.sampled_from([0.0, 0.5, 1.0, 2.0]))
def test_range_limit_only_removes_longer_edges(points: np.ndarray, max_range: float) -> None:
    np.testing.assert_array_equal(gabriel_graph(points, max_range), by_definition(points, max_range))


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.integers(4, 30))
def test_is_part_of_delaunay_and_connected(seed: int, robots: int) -> None:
    points = np.random.default_rng(seed).uniform(0, 5, (robots, 2))
    graph = gabriel_graph(points)
    delaunay = np.zeros_like(graph)
    for a, b, c in Delaunay(points).simplices:
        for i, j in ((a, b), (b, c), (c, a)):
            delaunay[i, j] = delaunay[j, i] = True
    assert not (graph & ~delaunay).any()
    reached = np.linalg.matrix_power(graph.astype(float) + np.eye(robots), robots) > 0
    assert reached.all()


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.floats(0.5, 3.0))
def test_what_one_robot_sees_suffices_for_its_own_edges(seed: int, reach: float) -> None:
    points = np.random.default_rng(seed).uniform(0, 5, (12, 2))
    limited = gabriel_graph(points, reach)
    for i in range(len(points)):
        seen = np.flatnonzero(np.linalg.norm(points - points[i], axis=1) <= reach)
        own = np.flatnonzero(seen == i)[0]
        np.testing.assert_array_equal(seen[gabriel_graph(points[seen], reach)[own]], np.flatnonzero(limited[i]))


def test_cocircular_robots_do_not_block() -> None:
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    assert gabriel_graph(square).sum() == 12


def test_coincident_robots_are_neighbours_and_block_nothing_of_each_other() -> None:
    points = np.array([[0.0, 0], [0, 0], [1, 0]])
    assert gabriel_graph(points).sum() == 6


def test_inactive_robots_have_and_block_nothing() -> None:
    points = np.array([[0.0, 0], [1, 0], [2, 0]])
    graph = gabriel_graph(points, active=np.array([True, False, True]))
    np.testing.assert_array_equal(np.argwhere(graph), [[0, 2], [2, 0]])
    points[1] = np.nan
    np.testing.assert_array_equal(gabriel_graph(points, active=np.array([True, False, True])), graph)


def test_batches_equal_single_worlds() -> None:
    points = np.random.default_rng(3).uniform(0, 4, (2, 5, 9, 2))
    batched = gabriel_graph(points, 2.0)
    for a in range(2):
        for b in range(5):
            np.testing.assert_array_equal(batched[a, b], gabriel_graph(points[a, b], 2.0))


@pytest.mark.parametrize(
    ("points", "max_range", "says"),
    [
        (np.zeros((3, 3)), np.inf, "shape"),
        (np.full((3, 2), np.nan), np.inf, "finite"),
        (np.zeros((3, 2)), -1.0, "max_range"),
        (np.zeros((3, 2)), np.nan, "max_range"),
    ],
)
def test_bad_input_is_refused(points: np.ndarray, max_range: float, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        gabriel_graph(points, max_range)
