"""A graph network whose robots talk to each other: a baseline that knows more than the Vision Transformer.

A node is a robot, an edge what one robot hears from another. In every round an edge learns what both its ends know, and
a robot sums over the edges on which it hears. Everything is told in the receivers' body frames, so commands do not
change with the world's orientation, nor with the order of the robots. What no single robot with a LiDAR has, and this
network has: true positions and headings of all within reach, even behind others, and what those know of robots farther
away.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from triform.policy.config import GnnConfig
from triform.policy.network import PolicyNetwork, to_device
from triform.policy.radius_graph import EDGE_FEATURES, SUM_SCALE, RadiusGraph


@dataclass(frozen=True)
class TeamBatch:
    """A ``RadiusGraph`` in PyTorch; attributes as there."""

    features: Tensor
    receivers: Tensor
    senders: Tensor
    robots: int


def team_batch(teams: RadiusGraph, device: torch.device | str = "cpu") -> TeamBatch:
    """Move teams into PyTorch."""
    features, receivers, senders = (
        to_device(array, device) for array in (teams.features, teams.receivers, teams.senders)
    )
    return TeamBatch(features, receivers, senders, teams.robots)


class Round(nn.Module):
    """One round of messages: MLPs on edges and on robots, each with a residual."""

    def __init__(self, config: GnnConfig) -> None:
        super().__init__()
        self.norm_robot = nn.LayerNorm(config.dim)
        self.norm_edge = nn.LayerNorm(config.dim)
        self.from_edge = nn.Linear(config.dim, config.mlp)
        self.from_receiver = nn.Linear(config.dim, config.mlp, bias=False)
        self.from_sender = nn.Linear(config.dim, config.mlp, bias=False)
        self.to_edge = nn.Linear(config.mlp, config.dim)
        self.expand = nn.Linear(2 * config.dim, config.mlp)
        self.contract = nn.Linear(config.mlp, config.dim)

    def forward(self, robots: Tensor, edges: Tensor, teams: TeamBatch) -> tuple[Tensor, Tensor]:
        """Transform robots (M, D) and edges (E, D)."""
        known = self.norm_robot(robots)
        # Ends are multiplied once for each robot rather than once for each edge.
        receiver = torch.index_select(self.from_receiver(known), 0, teams.receivers)
        sender = torch.index_select(self.from_sender(known), 0, teams.senders)
        hidden = self.from_edge(self.norm_edge(edges)) + receiver + sender
        edges = edges + self.to_edge(functional.gelu(hidden))
        heard = torch.zeros_like(robots).index_add(0, teams.receivers, edges.to(robots.dtype)) * SUM_SCALE
        hidden = self.expand(torch.cat([known, heard], dim=1))
        return robots + self.contract(functional.gelu(hidden)), edges


class GraphNetwork(PolicyNetwork):
    """Team -> commands of all its robots: rounds of messages over its edges, an MLP on every robot."""

    def __init__(self, config: GnnConfig) -> None:
        super().__init__()
        self.config = config
        self.start = nn.Parameter(torch.zeros(config.dim))
        self.embed = nn.Sequential(nn.Linear(EDGE_FEATURES, config.mlp), nn.GELU(), nn.Linear(config.mlp, config.dim))
        self.rounds = nn.ModuleList(Round(config) for _ in range(config.rounds))
        self.add_head(config)

    def encode(self, teams: TeamBatch) -> tuple[Tensor, Tensor]:
        """Features of edges (E, D) and of robots (M, D)."""
        robots, edges = self.start.expand(teams.robots, -1), self.embed(teams.features)
        for each in self.rounds:
            robots, edges = each(robots, edges, teams)
        return edges, robots
