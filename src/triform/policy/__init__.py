"""Networks and nothing else: their shape, packing, checkpoints and the run-time without PyTorch.

The modules ``vit``, ``weights`` and ``export``, which need PyTorch, and ``graph``, which needs ONNX, are imported by
name where they are needed, so that this package loads without either.
"""

from triform.policy.checkpoint import PolicySpec, read_spec
from triform.policy.config import NetworkConfig
from triform.policy.packing import Keep, PackedMaps, append_patches, pack
from triform.policy.runtime import PolicyRuntime

__all__ = [
    "Keep",
    "NetworkConfig",
    "PackedMaps",
    "PolicyRuntime",
    "PolicySpec",
    "append_patches",
    "pack",
    "read_spec",
]
