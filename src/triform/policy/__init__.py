"""Networks and nothing else: their shape, packing, checkpoints and the run-time without PyTorch.

The modules ``network``, ``vit``, ``cnn``, ``gnn``, ``kinds``, ``weights`` and ``export``, which need PyTorch, and
``graph``, ``cnn_graph`` and ``gnn_graph``, which need ONNX, are imported by name where they are needed, so that this
package loads without either.
"""

from triform.policy.checkpoint import PolicySpec, read_spec
from triform.policy.config import (
    CnnConfig,
    GnnConfig,
    MapNetwork,
    Network,
    NetworkConfig,
    describe_network,
    map_network,
    vit_network,
)
from triform.policy.gnn_runtime import GnnRuntime
from triform.policy.packing import Keep, PackedMaps, append_patches, pack
from triform.policy.radius_graph import RadiusGraph, hear
from triform.policy.reading import AttentionReader
from triform.policy.runtime import PolicyRuntime

__all__ = [
    "AttentionReader",
    "CnnConfig",
    "GnnConfig",
    "GnnRuntime",
    "Keep",
    "MapNetwork",
    "Network",
    "NetworkConfig",
    "PackedMaps",
    "PolicyRuntime",
    "PolicySpec",
    "RadiusGraph",
    "append_patches",
    "describe_network",
    "hear",
    "map_network",
    "pack",
    "read_spec",
    "vit_network",
]
