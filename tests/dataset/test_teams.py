from __future__ import annotations

import numpy as np
import pytest

from triform.control import Triangulating, TriangulatingLaw
from triform.dataset import SceneConfig, StateBuffer, TeamStates, draw_states, fresh_inputs, label_states
from triform.policy import GnnConfig, NetworkConfig, PolicySpec, RadiusGraph
from triform.types import MapConfig, PrivilegedView, Scan, ScanConfig

REACH = 2.1


def some_states(seed: int, robots: int = 200) -> TeamStates:
    visited = StateBuffer.of_teams(np.random.default_rng(seed).uniform(0, 4, (6, 9, 2)))
    return draw_states(np.random.default_rng(seed), robots, SceneConfig(placed=0.5), visited)


def test_states_are_whole_teams_and_functions_of_the_generator() -> None:
    states = some_states(1)
    assert 200 <= len(states.poses) < 200 + 50
    assert states.offsets[-1] == len(states.poses)
    assert states.offsets[-2] < 200
    assert len(states) == len(states.offsets) - 1
    assert (np.abs(states.poses[:, 2]) <= np.pi).all()
    assert len(np.unique(states.blocking)) > 5
    again = some_states(1)
    np.testing.assert_array_equal(states.poses, again.poses)
    assert not np.array_equal(states.poses[:50], some_states(2).poses[:50])


def test_without_visited_states_all_are_placements() -> None:
    states = draw_states(np.random.default_rng(0), 100, SceneConfig(), StateBuffer.none())
    sizes = np.diff(states.offsets)
    assert SceneConfig().sizes[0] <= sizes.min()
    assert sizes.max() <= SceneConfig().sizes[1]
    for first, last in zip(states.offsets[:-1], states.offsets[1:], strict=True):
        apart = np.linalg.norm(states.poses[first:last, None, :2] - states.poses[None, first:last, :2], axis=2)
        assert apart[~np.eye(len(apart), dtype=bool)].min() >= 0.45


def test_labels_are_what_the_law_commands() -> None:
    law, states = TriangulatingLaw(sight=REACH), some_states(3)
    labels = label_states(states, states.graph(REACH), law, 2.0, 0.5)
    for team in range(len(states)):
        alone = states.part(team, team + 1)
        # A wide robot is seen as long as its near side is within the LiDAR's range.
        sight = min(law.sight, 2.0 + 0.7 * alone.blocking[0])
        controller = Triangulating(max_speed=0.5, law=law, blocking_radius=float(alone.blocking[0]))
        farthest = np.linalg.norm(alone.poses[:, None, :2] - alone.poses[None, :, :2], axis=2)
        if ((farthest > sight) & (farthest <= law.sight)).any():
            continue
        robots = len(alone.poses)
        scans = Scan(np.full((1, robots, 4), np.inf), ScanConfig(rays=4))
        view = PrivilegedView(scans, np.ones((1, robots), dtype=bool), 0.0, alone.poses[None])
        wanted = labels.commands[states.offsets[team] : states.offsets[team + 1]]
        np.testing.assert_allclose(controller.command(view)[0], wanted[:, :3], atol=1e-9)
    assert (labels.commands[:, 3] > 0).any()


def test_terms_belong_to_their_edges() -> None:
    """What a robot sees of others adds up to its command where nothing else moves it."""
    states = some_states(4)
    graph = states.graph(REACH)
    labels = label_states(states, graph, TriangulatingLaw(sight=REACH), 2.0, np.inf)
    assert 0.3 < labels.seen.mean() < 1.0
    assert not labels.edge_features[~labels.seen].any()
    sums = np.zeros((graph.robots, 2))
    np.add.at(sums, graph.receivers, labels.edge_features[:, :2])
    calm = (labels.features[:, 0] == 0) & (labels.features[:, 2] == 0)
    assert calm.sum() > 10
    np.testing.assert_allclose(sums[calm], labels.commands[calm, :2], atol=1e-9)
    # Neighbours are mutual among robots that see each other's surroundings alike; at least most are.
    linked_by_law = labels.edge_features[:, 2]
    edges = {(i, j): linked for i, j, linked in zip(graph.receivers, graph.senders, linked_by_law, strict=True)}
    linked = [edge for edge, value in edges.items() if value]
    assert np.mean([edges[j, i] for i, j in linked]) > 0.8
    along = graph.features[:, :2] / graph.features[:, 2:3]
    close = labels.seen & (graph.features[:, 2] < 0.6)
    assert ((along * labels.edge_features[:, :2]).sum(axis=1)[close] < 0).all()


def test_a_shorter_reach_leaves_out_edges_and_nothing_else() -> None:
    states, law = some_states(5), TriangulatingLaw(sight=REACH)
    far, near = states.graph(REACH), states.graph(1.2)
    labels, fewer = label_states(states, far, law, 2.0, 0.5), label_states(states, near, law, 2.0, 0.5)
    np.testing.assert_array_equal(labels.commands, fewer.commands)
    kept = far.features[:, 2] <= np.float32(1.2)
    np.testing.assert_array_equal(labels.edge_features[kept], fewer.edge_features)
    np.testing.assert_array_equal(labels.seen[kept], fewer.seen)


@pytest.mark.parametrize("kind", ["maps", "teams"])
def test_fresh_inputs_are_what_the_network_reads(kind: str) -> None:
    network = GnnConfig() if kind == "teams" else NetworkConfig()
    given = fresh_inputs(np.random.default_rng(0), 30, PolicySpec(network, ScanConfig(), MapConfig()))
    if isinstance(given, RadiusGraph):
        assert kind == "teams"
        assert given.robots >= 30
    else:
        assert kind == "maps"
        assert given.shape == (30, 100, 100)
        assert given.any()
