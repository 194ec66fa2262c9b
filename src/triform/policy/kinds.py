"""The kinds of policy networks: made from their shapes, fed, and written as graphs."""

from __future__ import annotations

from typing import Any

import torch

from triform.policy.cnn import ConvolutionalNetwork
from triform.policy.cnn_graph import build_cnn_graph
from triform.policy.config import CnnConfig, GnnConfig, Network, NetworkConfig
from triform.policy.gnn import GraphNetwork, team_batch
from triform.policy.gnn_graph import build_gnn_graph
from triform.policy.graph import Graph, build_graph
from triform.policy.network import PolicyNetwork
from triform.policy.packing import PackedMaps
from triform.policy.radius_graph import RadiusGraph
from triform.policy.vit import VisionTransformer, token_batch

#: The network of every kind of shape, and what writes its graph.
_KINDS: dict[type[Network], tuple[Any, Any]] = {
    NetworkConfig: (VisionTransformer, build_graph),
    CnnConfig: (ConvolutionalNetwork, build_cnn_graph),
    GnnConfig: (GraphNetwork, build_gnn_graph),
}


def make_network(config: Network) -> PolicyNetwork:
    """A network of this kind and shape with random weights."""
    network: PolicyNetwork = _KINDS[type(config)][0](config)
    return network


def network_inputs(given: PackedMaps | RadiusGraph, device: torch.device | str = "cpu") -> Any:
    """What a network reads, in PyTorch."""
    return team_batch(given, device) if isinstance(given, RadiusGraph) else token_batch(given, device)


def write_graph(config: Network, weights: bytes, file_name: str) -> bytes:
    """Write a network as an ONNX model whose weights stand in a safetensors file beside it.

    Args:
        config: Shape of the network.
        weights: Content of the safetensors file.
        file_name: Name of that file, which must lie in the model's folder.

    Returns:
        The serialised model.

    Raises:
        TriformError: If the weights are not those of such a network.
    """
    graph: bytes = _KINDS[type(config)][1](Graph(weights, file_name), config)
    return graph
