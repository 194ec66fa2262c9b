from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.control import Expert, Teacher
from triform.geometry import body_to_world, gabriel_graph
from triform.types import ConfigurationError, PrivilegedView, Scan, ScanConfig, TriformError, View

seeds = st.integers(0, 2**32 - 1)


def view(poses: np.ndarray, active: np.ndarray | None = None) -> PrivilegedView:
    shape = poses.shape[:2]
    active = np.ones(shape, dtype=bool) if active is None else active
    return PrivilegedView(Scan(np.full((*shape, 450), np.inf), ScanConfig()), active, 0.0, poses)


def random_poses(seed: int, robots: int = 7, worlds: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.concatenate(
        [rng.uniform(0, 4, (worlds, robots, 2)), rng.uniform(-np.pi, np.pi, (worlds, robots, 1))], axis=-1
    )


def in_world(expert: Expert, poses: np.ndarray) -> np.ndarray:
    return body_to_world(expert.command(view(poses))[..., :2], poses[..., 2])


def potential(positions: np.ndarray, graph: np.ndarray) -> float:
    i, j = np.nonzero(np.triu(graph))
    return float(0.5 * np.sum((np.linalg.norm(positions[i] - positions[j], axis=1) - 1.0) ** 2))


@settings(deadline=None, max_examples=40)
@given(seeds)
def test_moves_down_the_gradient_of_the_spring_potential(seed: int) -> None:
    poses = random_poses(seed)
    graph = gabriel_graph(poses[0, :, :2])
    commands = in_world(Expert(max_speed=1e9), poses)[0]
    step = 1e-6
    for i in range(7):
        for axis in range(2):
            ahead, behind = poses[0, :, :2].copy(), poses[0, :, :2].copy()
            ahead[i, axis] += step
            behind[i, axis] -= step
            slope = (potential(ahead, graph) - potential(behind, graph)) / (2 * step)
            assert commands[i, axis] == pytest.approx(-slope, abs=1e-5)


@settings(deadline=None, max_examples=40)
@given(seeds, st.floats(-np.pi, np.pi))
def test_turns_and_moves_with_the_world(seed: int, angle: float) -> None:
    poses = random_poses(seed)
    turned = poses.copy()
    turned[..., :2] = body_to_world(poses[..., :2], angle) + [3.0, -1.0]
    turned[..., 2] += angle
    # Seen from the robots nothing has changed.
    np.testing.assert_allclose(Expert().command(view(turned)), Expert().command(view(poses)), atol=1e-6)


@settings(deadline=None, max_examples=40)
@given(seeds)
def test_names_of_robots_do_not_matter(seed: int) -> None:
    poses = random_poses(seed)
    order = np.random.default_rng(seed).permutation(7)
    np.testing.assert_allclose(
        Expert().command(view(poses[:, order])), Expert().command(view(poses))[:, order], atol=1e-12
    )


def test_rests_at_a_perfect_triangulation() -> None:
    angles = np.arange(6) * np.pi / 3
    hexagon = np.concatenate([[[0.0, 0.0]], np.stack([np.cos(angles), np.sin(angles)], axis=1)])
    poses = np.concatenate([hexagon, np.linspace(-3, 3, 7)[:, None]], axis=1)[None]
    np.testing.assert_allclose(Expert().command(view(poses)), 0, atol=1e-12)


def test_far_neighbours_attract_and_near_ones_repel() -> None:
    """The sign that Eq. 8 has as printed would do the opposite."""
    poses = np.array([[[0.0, 0, 0], [1.5, 0, 0]], [[0.0, 0, 0], [0.6, 0, 0]]])
    commands = Expert().command(view(poses))
    assert commands[0, 0, 0] == pytest.approx(0.5)
    assert commands[1, 0, 0] == pytest.approx(-0.4)
    np.testing.assert_allclose(commands[..., 2], 0)


@settings(deadline=None, max_examples=30)
@given(seeds, st.floats(0.05, 2.0))
def test_the_speed_limit_keeps_the_direction(seed: int, limit: float) -> None:
    poses = random_poses(seed)
    free, limited = in_world(Expert(max_speed=1e9), poses), in_world(Expert(max_speed=limit), poses)
    speed = np.linalg.norm(free, axis=-1, keepdims=True)
    np.testing.assert_allclose(limited, free * np.minimum(1, limit / np.maximum(speed, 1e-12)), atol=1e-12)


@settings(deadline=None, max_examples=30)
@given(seeds)
def test_sensed_expert_knows_nothing_beyond_its_range(seed: int) -> None:
    poses = random_poses(seed, robots=9)
    expert = Expert(sensing_range=2.0)
    whole = expert.command(view(poses))[0]
    for i in range(9):
        near = np.linalg.norm(poses[0, :, :2] - poses[0, i, :2], axis=1) <= 2.0
        own = int(near[:i].sum())
        np.testing.assert_allclose(expert.command(view(poses[:, near]))[0, own], whole[i], atol=1e-12)


def test_inactive_robots_neither_move_nor_count() -> None:
    poses = np.array([[[0.0, 0, 0], [0.7, 0, 0], [1.5, 0, 0]]])
    active = np.array([[True, False, True]])
    poses[0, 1] = np.nan
    commands = Expert().command(view(poses, active))
    np.testing.assert_allclose(commands, [[[0.5, 0, 0], [0, 0, 0], [-0.5, 0, 0]]], atol=1e-12)


def test_coincident_robots_exert_no_force() -> None:
    assert not Expert().command(view(np.zeros((1, 2, 3)))).any()


def test_a_view_without_poses_is_refused() -> None:
    blind = View(Scan(np.full((1, 2, 450), np.inf), ScanConfig()), np.ones((1, 2), dtype=bool), 0.0)
    with pytest.raises(TriformError, match="true poses"):
        Expert().command(blind)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["distance", "gain", "max_speed", "sensing_range"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_values_that_make_no_sense_are_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigurationError, match=name):
        Expert(**{name: value})


@settings(deadline=None, max_examples=30)
@given(seeds, st.floats(0.1, 2.0))
def test_the_odd_spring_adds_each_edges_pull_turned_by_a_quarter(seed: int, odd_gain: float) -> None:
    poses = random_poses(seed)
    even = in_world(Expert(max_speed=1e9), poses)
    both = in_world(Expert(max_speed=1e9, odd_gain=odd_gain), poses)
    quarter = np.stack([-even[..., 1], even[..., 0]], axis=-1)
    np.testing.assert_allclose(both, even + odd_gain * quarter, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "reach", "odd_gain"), [("expert", np.inf, 0.0), ("expert-sensed", 2.0, 0.0), ("expert-odd", 2.12, 0.8)]
)
def test_a_teacher_labels_as_the_expert_of_its_name_commands(name: str, reach: float, odd_gain: float) -> None:
    poses = random_poses(5, robots=8, worlds=6)
    expert = Expert(sensing_range=reach, odd_gain=odd_gain)
    assert expert.description["name"] == name
    np.testing.assert_array_equal(Teacher(name).label(poses), expert.command(view(poses)))
    np.testing.assert_array_equal(Expert.named(name).command(view(poses)), expert.command(view(poses)))


def test_unknown_teachers_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="no expert 'nobody'"):
        Teacher("nobody")
