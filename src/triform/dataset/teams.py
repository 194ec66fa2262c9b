"""Fresh states of whole teams for a graph network: who hears whom, and what the law does for every robot.

States are drawn as those of ``scenes.py``, and so are the outlines of robots, which decide who hides whom from the law.
The network is told the true poses, as if over a perfect radio, so there is neither scan nor noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triform.control.triangulating import TriangulatingLaw
from triform.control.triangulating_kernels import LAW_EDGE_FEATURES, LAW_FEATURES, law_workspace
from triform.dataset.scenes import (
    SceneConfig,
    blocking_radius,
    buffered_states,
    draw_body,
    draw_positions,
    label_robot,
    longest_team,
    scene_draws,
)
from triform.dataset.state_buffer import StateBuffer
from triform.kernels import kernel
from triform.policy import RadiusGraph, hear
from triform.types import BoolArray, FloatArray, IntArray

#: A robot of the law is the one of an edge if both lie in the same place; two sums may differ in the last bits [d*].
_SAME_PLACE = 1e-9


@dataclass(frozen=True)
class TeamStates:
    """Where the robots of T teams stand, in d*.

    Attributes:
        poses: Poses, team behind team, shape (M, 3).
        offsets: Where every team begins, and the end of the last one, shape (T + 1,).
        blocking: Radius of the disc for which a robot of each team blocks sight, shape (T,).
    """

    poses: FloatArray
    offsets: IntArray
    blocking: FloatArray

    def __len__(self) -> int:
        return len(self.blocking)

    def part(self, first: int, last: int) -> TeamStates:
        """The teams ``first <= t < last``."""
        begin, end = self.offsets[first], self.offsets[last]
        return TeamStates(self.poses[begin:end], self.offsets[first : last + 1] - begin, self.blocking[first:last])

    def graph(self, reach: float) -> RadiusGraph:
        """Who hears whom within ``reach`` [d*]."""
        return hear(self.poses, self.offsets, self.blocking, reach)


@dataclass(frozen=True)
class TeamLabels:
    """What the law does in some teams, in the robots' body frames.

    Attributes:
        commands: Mean velocity (x, y), turn rate (0) and amplitude of the push [d*/s, rad/s, d*/s], shape (M, 4).
        edge_features: For every edge of the graph, what the sender adds to the receiver's velocity (2) [d*/s], whether
            it is a Gabriel neighbour and whether it shares one with the receiver, shape (E, LAW_EDGE_FEATURES).
        seen: Edges whose sender the law sees, shape (E,); the others' features are zero.
        features: Features of ``LawWorkspace``, shape (M, LAW_FEATURES).
    """

    commands: FloatArray
    edge_features: FloatArray
    seen: BoolArray
    features: FloatArray


@kernel
def _draw_states(rng, robots, visited, draws, poses, offsets, blocking):
    """Fill ``poses``, ``offsets`` and ``blocking`` of ``TeamStates`` until they hold ``robots`` robots.

    The states come from ``BufferedStates`` and ``SceneDraws``; returns the number of teams.
    """
    team = np.empty((longest_team(visited, draws), 2))
    teams = 0
    offsets[0] = 0
    while offsets[teams] < robots:
        count = draw_positions(rng, visited, draws, team)
        if count == 0:
            continue
        _, body = draw_body(rng, draws)
        blocking[teams] = blocking_radius(body)
        first = offsets[teams]
        for k in range(count):
            poses[first + k, 0], poses[first + k, 1] = team[k, 0], team[k, 1]
            poses[first + k, 2] = (2.0 * rng.random() - 1.0) * np.pi
        teams += 1
        offsets[teams] = first + count
    return teams


@kernel
def _label_states(
    poses, offsets, blocking, law, reach, max_speed, receivers, senders, commands, edge_features, seen, features
):
    """Fill ``commands``, ``edge_features``, ``seen`` and ``features`` of ``TeamLabels``; other arguments as there."""
    longest = 1
    for t in range(blocking.shape[0]):
        longest = max(longest, offsets[t + 1] - offsets[t])
    workspace = law_workspace(longest)
    around = np.empty((longest, 2 + LAW_EDGE_FEATURES))
    edge = 0
    for t in range(blocking.shape[0]):
        first = offsets[t]
        team = poses[first : offsets[t + 1]]
        for i in range(team.shape[0]):
            own = first + i
            label_robot(team, i, team[i, 2], law, blocking[t], reach, max_speed, workspace, commands[own], around)
            features[own] = workspace.features
            cos, sin = np.cos(team[i, 2]), np.sin(team[i, 2])
            # Both lists name robots in growing order.
            at = 0
            while edge < receivers.shape[0] and receivers[edge] == own:
                j = senders[edge] - first
                d_x, d_y = team[j, 0] - team[i, 0], team[j, 1] - team[i, 1]
                x, y = cos * d_x + sin * d_y, cos * d_y - sin * d_x
                edge_features[edge], seen[edge] = 0.0, False
                for k in range(at, longest):
                    if abs(around[k, 0] - x) < _SAME_PLACE and abs(around[k, 1] - y) < _SAME_PLACE:
                        for c in range(LAW_EDGE_FEATURES):
                            edge_features[edge, c] = around[k, 2 + c]
                        seen[edge] = True
                        at = k + 1
                        break
                edge += 1


def draw_states(rng: np.random.Generator, robots: int, config: SceneConfig, visited: StateBuffer) -> TeamStates:
    """Draw random states of whole teams until they have at least ``robots`` robots.

    Args:
        rng: Source of all randomness; the states are a function of its state alone.
        robots: Robots wanted.
        config: What varies; of the sensor and of arenas nothing is used.
        visited: States to draw from; without any, all states are random placements.
    """
    states, draws = buffered_states(visited), scene_draws(config)
    longest = longest_team(states, draws)
    poses = np.empty((robots + longest, 3))
    offsets, blocking = np.empty(robots + 1, dtype=np.int64), np.empty(robots)
    teams = _draw_states(rng, robots, states, draws, poses, offsets, blocking)
    return TeamStates(poses[: offsets[teams]], offsets[: teams + 1], blocking[:teams])


def label_states(
    states: TeamStates, graph: RadiusGraph, law: TriangulatingLaw, reach: float, max_speed: float
) -> TeamLabels:
    """Label every robot.

    Args:
        states: Where they stand.
        graph: Who hears whom there.
        law: What labels them.
        reach: How far the LiDAR of a robot reaches [d*].
        max_speed: Longer mean velocities are scaled to this [d*/s].
    """
    robots, edges = len(states.poses), len(graph.receivers)
    seen: NDArray[np.bool_] = np.empty(edges, dtype=np.bool_)
    out = TeamLabels(
        np.empty((robots, 4)), np.empty((edges, LAW_EDGE_FEATURES)), seen, np.empty((robots, LAW_FEATURES))
    )
    _label_states(
        states.poses, states.offsets, states.blocking, law.constants, reach, max_speed, graph.receivers, graph.senders,
        out.commands, out.edge_features, out.seen, out.features,
    )  # fmt: skip
    return out
