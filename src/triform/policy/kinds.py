"""The kinds of policy networks: made from their shapes, fed, and written as graphs."""

from __future__ import annotations

from typing import Any

import torch

from triform.policy.cnn import ConvolutionalNetwork
from triform.policy.cnn_graph import build_cnn_graph
from triform.policy.config import CnnConfig, GnnConfig, Network
from triform.policy.gnn import GraphNetwork, team_batch
from triform.policy.gnn_graph import build_gnn_graph
from triform.policy.graph import build_graph
from triform.policy.network import PolicyNetwork
from triform.policy.packing import PackedMaps
from triform.policy.radius_graph import RadiusGraph
from triform.policy.vit import VisionTransformer, token_batch


def make_network(config: Network) -> PolicyNetwork:
    """A network of this kind and shape with random weights."""
    if isinstance(config, CnnConfig):
        return ConvolutionalNetwork(config)
    if isinstance(config, GnnConfig):
        return GraphNetwork(config)
    return VisionTransformer(config)


def network_inputs(given: PackedMaps | RadiusGraph, device: torch.device | str = "cpu") -> Any:
    """What a network reads, in PyTorch."""
    return team_batch(given, device) if isinstance(given, RadiusGraph) else token_batch(given, device)


def write_graph(config: Network, weights: bytes, file_name: str) -> bytes:
    """Write a network as an ONNX model, see ``build_graph``.

    Raises:
        TriformError: If the weights are not those of such a network.
    """
    if isinstance(config, CnnConfig):
        return build_cnn_graph(config, weights, file_name)
    if isinstance(config, GnnConfig):
        return build_gnn_graph(config, weights, file_name)
    return build_graph(config, weights, file_name)
