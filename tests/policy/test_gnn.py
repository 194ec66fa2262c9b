from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.policy import GnnConfig, GnnRuntime, PolicyRuntime, PolicySpec, RadiusGraph, hear
from triform.policy.export import export_policy
from triform.policy.gnn import GraphNetwork, team_batch
from triform.policy.weights import load_policy, save_policy
from triform.types import ConfigurationError, MapConfig, ScanConfig

SMALL = GnnConfig(dim=12, rounds=2, mlp=20)
SPEC = PolicySpec(SMALL, ScanConfig(), MapConfig())


def network(seed: int = 0) -> GraphNetwork:
    torch.manual_seed(seed)
    net = GraphNetwork(SMALL).eval()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return net


def some_poses(seed: int, robots: int, side: float = 4.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0, side, (robots, 2)), rng.uniform(-np.pi, np.pi, robots)])


def one_team(poses: np.ndarray) -> RadiusGraph:
    return hear(poses, np.array([0, len(poses)]), np.array([0.14]), SMALL.reach)


def run(net: GraphNetwork, teams: RadiusGraph) -> np.ndarray:
    with torch.no_grad():
        return net(team_batch(teams)).numpy()


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gnn") / "small"
    save_policy(folder, network(), SPEC)
    assert export_policy(folder, one_team(some_poses(1, 30))).largest <= 1e-4
    return folder


@given(seed=st.integers(0, 1000), sizes=st.lists(st.integers(0, 12), max_size=5), reach=st.floats(0.1, 5.0))
@settings(max_examples=30, deadline=None)
def test_robots_hear_those_of_their_team_within_reach(seed: int, sizes: list[int], reach: float) -> None:
    offsets = np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)]).astype(np.int64)
    poses = some_poses(seed, offsets[-1])
    blocking = np.arange(len(sizes)) / 10
    graph = hear(poses, offsets, blocking, reach)
    expected = []
    for team, (first, last) in enumerate(itertools.pairwise(offsets)):
        for i in range(first, last):
            for j in range(first, last):
                apart = poses[j, :2] - poses[i, :2]
                if i != j and np.hypot(*apart) <= reach:
                    cos, sin = np.cos(poses[i, 2]), np.sin(poses[i, 2])
                    turn = poses[j, 2] - poses[i, 2]
                    body = np.array([[cos, sin], [-sin, cos]]) @ apart
                    expected.append((i, j, *body, np.hypot(*apart), np.cos(turn), np.sin(turn), blocking[team]))
    assert graph.robots == len(poses)
    found = np.column_stack([graph.receivers, graph.senders, graph.features])
    np.testing.assert_allclose(found, np.array(expected).reshape(-1, 8), atol=1e-5)


def test_large_teams_hear_as_small_ones() -> None:
    poses = some_poses(3, 60, side=8.0)
    graph = one_team(poses)
    distances = np.linalg.norm(poses[:, None, :2] - poses[None, :, :2], axis=2)
    receivers, senders = np.nonzero((distances <= SMALL.reach) & ~np.eye(60, dtype=bool))
    np.testing.assert_array_equal(graph.receivers, receivers)
    np.testing.assert_array_equal(graph.senders, senders)


@given(seed=st.integers(0, 1000), robots=st.integers(1, 15), angle=st.floats(-10, 10))
@settings(max_examples=20, deadline=None)
def test_commands_do_not_change_with_the_world(seed: int, robots: int, angle: float) -> None:
    """Rotated and moved worlds give the same body twists."""
    poses, net = some_poses(seed, robots), network()
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.column_stack([poses[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + (3.0, -7.0), poses[:, 2] + angle])
    np.testing.assert_allclose(run(net, one_team(turned)), run(net, one_team(poses)), atol=1e-4)


@given(seed=st.integers(0, 1000), robots=st.integers(1, 15))
@settings(max_examples=20, deadline=None)
def test_commands_follow_the_order_of_the_robots(seed: int, robots: int) -> None:
    poses, net = some_poses(seed, robots), network()
    order = np.random.default_rng(seed).permutation(robots)
    np.testing.assert_allclose(run(net, one_team(poses[order])), run(net, one_team(poses))[order], atol=1e-4)


def test_news_travels_one_edge_a_round() -> None:
    """A line of robots, one apart: a robot knows of those whose messages have come to it, and of no others."""
    net, line = network(), np.column_stack([1.5 * np.arange(9), np.zeros(9), np.zeros(9)])
    before = run(net, one_team(line))
    line[8, 1] = 0.5
    changed = np.abs(run(net, one_team(line)) - before).max(axis=1) > 1e-6
    # In round 1 the edges of a robot are told to it, in round 2 those of its neighbours too.
    np.testing.assert_array_equal(changed, [False] * 6 + [True] * 3)


def test_gradients_reach_every_weight() -> None:
    net = network()
    edges, robots = net.encode(team_batch(one_team(some_poses(2, 9))))
    assert edges.shape[1] == SMALL.token_width
    (net.command(robots).square().sum() + edges.square().sum()).backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name


def test_onnx_runtime_equals_pytorch(exported: Path) -> None:
    net, spec = load_policy(exported)
    assert spec.network == SMALL
    runtime = GnnRuntime(exported)
    for robots in (1, 2, 7, 50):
        graph = one_team(some_poses(robots, robots))
        np.testing.assert_allclose(runtime.commands(graph), run(net, graph), atol=1e-4)


def test_what_a_team_gets_does_not_depend_on_the_others(exported: Path) -> None:
    runtime, sizes = GnnRuntime(exported), np.array([1, 2, 5, 1, 13, 8])
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    poses = some_poses(5, offsets[-1])
    together = runtime.commands(hear(poses, offsets, np.full(6, 0.14), SMALL.reach))
    apart = [runtime.commands(one_team(poses[a:b])) for a, b in itertools.pairwise(offsets)]
    np.testing.assert_array_equal(np.concatenate(apart), together)


def test_nobody_gets_nothing(exported: Path) -> None:
    nobody = hear(np.empty((0, 3)), np.array([0]), np.empty(0), 2.0)
    assert GnnRuntime(exported).commands(nobody).shape == (0, 4)


def test_wrong_input_is_refused(exported: Path) -> None:
    with pytest.raises(ConfigurationError, match="reads no occupancy maps"):
        PolicyRuntime(exported)
    graph = one_team(some_poses(0, 4))
    with pytest.raises(ConfigurationError, match="each end must be a robot"):
        GnnRuntime(exported).commands(replace(graph, robots=3))
    with pytest.raises(ConfigurationError, match="growing offsets"):
        hear(some_poses(0, 4), np.array([0, 3]), np.array([0.1]), 2.0)
    with pytest.raises(ConfigurationError, match="in float32 only"):
        export_policy(exported, graph, "int8")
    with pytest.raises(ConfigurationError, match="rounds"):
        GnnConfig(rounds=0)
    with pytest.raises(ConfigurationError, match="reach"):
        GnnConfig(reach=0.0)
