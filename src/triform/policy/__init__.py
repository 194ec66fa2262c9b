"""Networks and nothing else: their shape, packing, checkpoints and the run-time without PyTorch.

The PyTorch modules (``vit``, ``weights``, ``export``) are imported by name where they are needed, so that this package
loads without PyTorch.
"""

from triform.policy.checkpoint import PolicySpec, read_spec
from triform.policy.config import NetworkConfig
from triform.policy.packing import PackedMaps, pack
from triform.policy.runtime import PolicyRuntime

__all__ = ["NetworkConfig", "PackedMaps", "PolicyRuntime", "PolicySpec", "pack", "read_spec"]
