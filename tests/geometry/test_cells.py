"""Large teams, whose neighbours are searched by cells, against the definitions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from triform.geometry import assess, edge_error, gabriel_graph, smallest_distance
from triform.geometry.cells import CELL_SIZE, SMALL_TEAM, find_near, list_cells, make_cells, pairs_within
from triform.threads import limit_threads

KINDS = ["uniform", "clustered", "far clusters", "grid", "coarse grid", "coincident", "line", "rings", "spread", "lone"]


def placement(kind: str, robots: int, rng: np.random.Generator) -> np.ndarray:
    """Positions (N, 2), many of them with exact ties."""
    if kind == "uniform":
        return rng.uniform(0, 5 * np.sqrt(robots / 13), (robots, 2))
    if kind == "clustered":
        return rng.normal(0, 0.2, (robots, 2)) + rng.uniform(0, 10, (3, 2))[rng.integers(3, size=robots)]
    if kind == "far clusters":
        return rng.normal(0, 1.0, (robots, 2)) + rng.choice([0.0, 1e4, 1e8], (robots, 1))
    if kind == "grid":
        side = int(np.ceil(np.sqrt(robots)))
        return rng.permutation(np.stack(np.divmod(np.arange(robots), side), axis=1)) / 4.0
    if kind == "coarse grid":
        return rng.integers(0, 6, (robots, 2)) / 2.0
    if kind == "coincident":
        return np.repeat(rng.integers(0, 5, (robots // 8 + 1, 2)), 8, axis=0)[:robots].astype(float)
    if kind == "line":
        return np.stack([np.zeros(robots), rng.permutation(robots) / 2.0], axis=1)
    if kind == "rings":
        # Rows and columns of whole numbers on circles around the origin: many exactly cocircular robots.
        ring = [(x, y) for x in range(-25, 26) for y in range(-25, 26) if x * x + y * y in (0, 25, 325, 625)]
        return np.resize(rng.permutation(np.array(ring, dtype=float)), (robots, 2))
    if kind == "spread":
        return rng.standard_cauchy((robots, 2)) * 10.0 ** rng.uniform(-3, 9, (robots, 1))
    return np.concatenate([rng.uniform(0, 8, (robots - 1, 2)), [[1e12, -1e12]]])


def by_definition(points: np.ndarray, active: np.ndarray, max_range: float) -> np.ndarray:
    """Who sees whom with nobody between who sees both under an obtuse angle, O(N^3)."""
    x, y = points[:, 0], points[:, 1]
    graph = np.zeros((len(points), len(points)), dtype=bool)
    for i in np.flatnonzero(active):
        for j in np.flatnonzero(active[:i]):
            if (x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2 <= max_range**2:
                blocks = active & ((x[i] - x) * (x[j] - x) + (y[i] - y) * (y[j] - y) < 0)
                blocks[[i, j]] = False
                graph[i, j] = graph[j, i] = not blocks.any()
    return graph


large_teams = st.tuples(
    st.sampled_from(KINDS), st.integers(SMALL_TEAM + 1, 90), st.integers(0, 2**32 - 1), st.booleans()
)


def draw(team: tuple[str, int, int, bool]) -> tuple[np.ndarray, np.ndarray]:
    kind, robots, seed, all_active = team
    rng = np.random.default_rng(seed)
    points = placement(kind, robots, rng)
    active = np.ones(robots, dtype=bool) if all_active else rng.random(robots) < 0.85
    return points, active


@settings(deadline=None, max_examples=80)
@given(large_teams, st.sampled_from([0.0, 0.5, 2.0, 50.0, np.inf]))
def test_edges_are_those_of_the_definition(team: tuple[str, int, int, bool], max_range: float) -> None:
    points, active = draw(team)
    expected = by_definition(points, active, max_range)
    points[~active] = np.nan
    np.testing.assert_array_equal(gabriel_graph(points, max_range, active), expected)


@pytest.mark.parametrize("kind", KINDS)
def test_small_and_large_teams_meet_without_a_seam(kind: str) -> None:
    for robots in (1, 2, 3, SMALL_TEAM - 1, SMALL_TEAM, SMALL_TEAM + 1, 3 * CELL_SIZE):
        points = placement(kind, robots, np.random.default_rng(robots))
        for max_range in (1.0, np.inf):
            expected = by_definition(points, np.ones(robots, dtype=bool), max_range)
            np.testing.assert_array_equal(gabriel_graph(points, max_range), expected)


@settings(deadline=None, max_examples=60)
@given(large_teams, st.sampled_from([0.0, 0.3, 2.0, 1e5]))
def test_pairs_within_a_distance_are_all_found(team: tuple[str, int, int, bool], distance: float) -> None:
    points, active = draw(team)
    squared = ((points[:, None] - points) ** 2).sum(axis=-1)
    expected = np.triu((squared <= distance**2) & active & active[:, None], k=1)
    found = np.sort(pairs_within(points, active, distance**2), axis=1)
    assert sorted(map(tuple, found)) == sorted(map(tuple, np.argwhere(expected)))


@settings(deadline=None, max_examples=60)
@given(large_teams)
def test_cells_hold_every_robot_once_and_boxes_hold_their_robots(team: tuple[str, int, int, bool]) -> None:
    points, active = draw(team)
    world = robots, places, parts, boxes = make_cells(points, active)
    np.testing.assert_array_equal(np.sort(robots), np.flatnonzero(active))
    np.testing.assert_array_equal(places, points[robots])
    assert len(parts) <= 2 * max(1, len(robots))
    cells = np.flatnonzero(parts[:, 2] == 0)
    assert (parts[cells, 1] - parts[cells, 0]).sum() == len(robots)
    stack, near = np.empty(128, dtype=np.int64), np.empty(len(robots), dtype=np.int64)
    for part, (first, last, half, _) in enumerate(parts):
        np.testing.assert_array_equal(boxes[part, :2], places[first:last].min(axis=0, initial=np.inf))
        np.testing.assert_array_equal(boxes[part, 2:], places[first:last].max(axis=0, initial=-np.inf))
        if half:
            assert [parts[half, 0], parts[half, 1], parts[half + 1, 1]] == [first, parts[half + 1, 0], last]
            assert (parts[half : half + 2, 3] == part).all()
        else:
            number = find_near(world, part, 4.0, stack, near)
            for own in range(first, last):
                close = np.flatnonzero(((places - places[own]) ** 2).sum(axis=1) <= 4.0)
                assert set(close) <= set(near[:number])


@settings(deadline=None, max_examples=40)
@given(large_teams, st.sampled_from([1.0, np.inf]))
def test_measures_of_large_teams(team: tuple[str, int, int, bool], max_range: float) -> None:
    points, active = draw(team)
    graph = by_definition(points, active, max_range)
    quality = assess(points, 0.7, max_range, active)
    edges = np.argwhere(np.triu(graph))
    errors = np.abs(np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) - 0.7) / 0.7
    assert quality.edges == len(edges)
    if len(edges):
        assert quality.edge_error == pytest.approx(errors.mean(), rel=1e-9)
    np.testing.assert_array_equal(edge_error(points, 0.7, max_range, active), quality.edge_error)
    groups = connected_components(graph[active][:, active], directed=False)[0] if active.any() else 0
    assert quality.connected == (groups == 1)
    squared = ((points[:, None] - points) ** 2).sum(axis=-1)[active][:, active]
    squared[np.diag_indices(len(squared))] = np.inf
    assert smallest_distance(points, active) == np.sqrt(squared.min(initial=np.inf))


def test_a_large_triangulation_is_strict_until_it_has_a_hole() -> None:
    lattice = np.array([[i + 0.5 * j, np.sqrt(3) / 2 * j] for j in range(20) for i in range(20)])
    assert assess(lattice).strict
    assert assess(lattice).edges == 3 * 400 - 2 * 40 + 1
    inside = np.arange(400) != 210
    assert not assess(lattice, active=inside).strict
    assert assess(lattice, active=inside).connected


def test_memory_is_linear_and_the_number_of_threads_changes_nothing() -> None:
    rng = np.random.default_rng(1)
    points = np.stack([placement("uniform", 20_000, rng), placement("uniform", 20_000, rng)])
    # A matrix of all pairs would take 400 MB.
    assert 1.9 < assess(points[0]).edges / 20_000 < 2.1
    both = edge_error(points)
    with limit_threads(1):
        np.testing.assert_array_equal(edge_error(points), both)


def test_every_share_of_the_cells_has_its_share_of_the_robots() -> None:
    positions = np.random.default_rng(3).uniform(0, 100, (20_000, 2))
    world = make_cells(positions, np.ones(len(positions), dtype=np.bool_))
    cells, parts = list_cells(world), world[2]
    sizes = parts[cells, 1] - parts[cells, 0]
    assert sizes.sum() == len(positions)
    for share in np.array_split(sizes, 16):
        assert 0.6 * len(positions) / 16 < share.sum() < 1.4 * len(positions) / 16
