"""Edges, triangles and colours of a picture against their definitions."""

from __future__ import annotations

import itertools

import networkx as nx
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.geometry import gabriel_graph
from triform.viewer.formation import Formation, between, stacked


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), robots=st.integers(1, 40), share=st.floats(0.5, 1.0))
def test_triangles_are_the_cliques_of_three(seed: int, robots: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    poses = rng.uniform(-3, 3, (robots, 3))
    active = rng.random(robots) < share
    formation = Formation.of(1.5, poses, active, 1.0)
    points = poses[active, :2]
    graph = nx.from_numpy_array(gabriel_graph(points)) if len(points) else nx.Graph()
    wanted = {
        trio
        for trio in itertools.combinations(range(len(points)), 3)
        if all(graph.has_edge(*pair) for pair in itertools.combinations(trio, 2))
    }
    assert {tuple(sorted(trio)) for trio in formation.triangles.tolist()} == wanted
    assert len(formation.triangles) == len(wanted)
    assert {tuple(edge) for edge in formation.edges.tolist()} == {tuple(sorted(edge)) for edge in graph.edges}
    lengths = {frozenset(edge): size for edge, size in zip(formation.edges.tolist(), formation.lengths, strict=True)}
    for trio, closed in zip(formation.triangles.tolist(), formation.closed, strict=True):
        sides = [lengths[frozenset(pair)] for pair in itertools.combinations(trio, 2)]
        assert closed == all(abs(side - 1.0) < 0.1 for side in sides)
    if len(formation.edges):
        np.testing.assert_allclose(formation.error, np.mean(np.abs(formation.lengths - 1.0)))
    else:
        assert np.isnan(formation.error)


def test_headings_turn_the_shortest_way() -> None:
    before, after = np.array([[0.0, 0.0, 3.0]]), np.array([[1.0, 2.0, -3.0]])
    halfway = between(before, after, 0.5)[0]
    np.testing.assert_allclose(halfway[:2], [0.5, 1.0])
    np.testing.assert_allclose(abs(halfway[2]), np.pi)


def test_robots_that_came_later_have_no_earlier_places() -> None:
    rows = stacked([np.zeros((2, 2)), np.ones((3, 2))], 3)
    assert rows.shape == (2, 3, 2)
    assert np.isnan(rows[0, 2]).all()
    np.testing.assert_array_equal(rows[1], 1.0)
