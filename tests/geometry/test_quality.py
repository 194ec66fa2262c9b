from __future__ import annotations

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.geometry import assess, edge_error, gabriel_graph
from triform.types import ConfigurationError

HEIGHT = np.sqrt(3) / 2
HEXAGON = np.concatenate([[[0.0, 0.0]], [[np.cos(a), np.sin(a)] for a in np.arange(6) * np.pi / 3]])


def strict_by_faces(points: np.ndarray, distance: float = 1.0) -> bool:
    """PROTOCOL's words on a planar embedding: walk every face and look at it."""
    graph = gabriel_graph(points)
    network = nx.from_numpy_array(graph)
    if len(points) < 3 or not nx.is_connected(network):
        return False
    for i, j in network.edges:
        if abs(np.linalg.norm(points[i] - points[j]) - distance) >= 0.1 * distance:
            return False
        if not set(network[i]) & set(network[j]):
            return False
    embedding = nx.PlanarEmbedding()
    for i in network:
        ordered = sorted(network[i], key=lambda j: -np.arctan2(*(points[j] - points[i])[::-1]))
        previous = None
        for j in ordered:
            embedding.add_half_edge(i, j, cw=previous)
            previous = j
    seen: set[tuple[int, int]] = set()
    faces = []
    for i, j in embedding.edges:
        if (i, j) not in seen:
            faces.append(embedding.traverse_face(i, j, seen))
    areas = [
        0.5 * np.sum(points[f, 0] * np.roll(points[f, 1], -1) - points[f, 1] * np.roll(points[f, 0], -1)) for f in faces
    ]
    outer = int(np.argmax(np.abs(areas))) if len({np.sign(a) for a in areas}) == 1 else None
    signs = np.sign(areas)
    # Exactly one face is walked the other way round: the outer one.
    outer = int(np.flatnonzero(signs == (1 if (signs > 0).sum() == 1 else -1))[0]) if outer is None else outer
    return all(len(face) == 3 for k, face in enumerate(faces) if k != outer)


def test_hexagon_is_a_perfect_triangulation() -> None:
    quality = assess(HEXAGON)
    assert quality.edge_error == pytest.approx(0, abs=1e-12)
    assert quality.edges == 12
    assert quality.connected
    assert quality.strict
    assert quality.compactness == 1.0


def test_line_at_the_right_spacing_is_no_triangulation() -> None:
    line = np.stack([np.arange(5.0), np.zeros(5)], axis=1)
    quality = assess(line)
    assert quality.edge_error == 0
    assert quality.connected
    assert not quality.strict


def test_ring_around_a_hole_is_no_triangulation() -> None:
    quality = assess(HEXAGON[1:])
    assert quality.edges == 6
    assert not quality.strict


def test_two_separate_triangles_are_not_connected_within_range() -> None:
    triangle = np.array([[0.0, 0], [1, 0], [0.5, HEIGHT]])
    points = np.concatenate([triangle, triangle + [10, 0]])
    assert not assess(points, max_range=2.0).connected
    assert not assess(points, max_range=2.0).strict


@pytest.mark.parametrize(
    ("robots", "best"),
    [(2, 1), (3, 3), (4, 5), (5, 7), (6, 9), (7, 12), (8, 14), (9, 16), (10, 19), (12, 24), (13, 26)],
)
def test_compactness_counts_against_known_contact_numbers(robots: int, best: int) -> None:
    rng = np.random.default_rng(robots)
    points = rng.uniform(0, 3, (robots, 2))
    quality = assess(points)
    assert quality.compactness == pytest.approx(quality.edges / best)


def test_one_and_no_robots() -> None:
    alone = assess(np.zeros((1, 2)))
    assert np.isnan(alone.edge_error)
    assert np.isnan(alone.compactness)
    assert alone.connected
    assert not alone.strict
    assert not assess(np.zeros((2, 2)), active=np.zeros(2, dtype=bool)).connected


@settings(deadline=None, max_examples=150)
@given(st.integers(0, 2**32 - 1), st.integers(3, 10), st.floats(0, 0.06))
def test_strict_agrees_with_walking_the_faces(seed: int, robots: int, jitter: float) -> None:
    rng = np.random.default_rng(seed)
    lattice = np.array([[i + 0.5 * j, HEIGHT * j] for i in range(-3, 4) for j in range(-3, 4)])
    start = rng.integers(len(lattice))
    order = np.argsort(np.linalg.norm(lattice - lattice[start], axis=1) + rng.uniform(0, 1.0, len(lattice)))
    points = lattice[order[:robots]] + rng.normal(0, jitter, (robots, 2)) + rng.normal(0, 1e-6, (robots, 2))
    assert bool(assess(points).strict) == strict_by_faces(points)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.floats(-np.pi, np.pi), st.floats(0.3, 3.0))
def test_measures_do_not_depend_on_frame_order_or_scale(seed: int, angle: float, scale: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 3, (8, 2))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = scale * (points[rng.permutation(8)] @ turn.T) + rng.uniform(-5, 5, 2)
    before, after = assess(points), assess(moved, distance=scale)
    assert after.edge_error == pytest.approx(before.edge_error, rel=1e-6)
    assert after.edges == before.edges
    assert bool(after.strict) == bool(before.strict)


def test_edge_error_is_that_of_assess_and_of_the_definition() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 4, (3, 20, 7, 2))
    series = edge_error(points, 0.8, 2.0)
    np.testing.assert_array_equal(series, assess(points, 0.8, 2.0).edge_error)
    i, j = np.nonzero(np.triu(gabriel_graph(points[1, 4], 2.0)))
    lengths = np.linalg.norm(points[1, 4, i] - points[1, 4, j], axis=1)
    assert series[1, 4] == pytest.approx(np.mean(np.abs(lengths - 0.8)) / 0.8)


def test_bad_distance_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="distance"):
        assess(HEXAGON, distance=0.0)


def test_no_robots_at_all_and_no_worlds() -> None:
    assert assess(np.zeros((3, 0, 2))).edges.tolist() == [0, 0, 0]
    assert not assess(np.zeros((0, 2))).connected
    assert assess(np.zeros((0, 4, 2))).edge_error.shape == (0,)
    assert gabriel_graph(np.zeros((2, 0, 2))).shape == (2, 0, 0)


def test_bad_range_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="max_range"):
        edge_error(HEXAGON, max_range=-1.0)
