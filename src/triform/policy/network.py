"""What all policy networks have in common while they learn; which kinds there are is in ``kinds.py``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from triform.policy.config import Network


class PolicyNetwork(ABC, nn.Module):
    """Computes the commands of M robots from whatever its kind of network reads.

    Besides commands it gives features of the M robots and of K *tokens*, from which auxiliary targets are learned.
    Tokens are what a robot sees of others: patches of its map, or edges to robots that it hears.
    """

    @abstractmethod
    def encode(self, inputs: Any) -> tuple[Tensor, Tensor]:
        """Features of tokens (K, ``config.token_width``) and of robots (M, ``config.dim``)."""

    def add_head(self, config: Network) -> None:
        """Add the layers that ``command`` computes, behind those that came before."""
        self.norm = nn.LayerNorm(config.dim)
        self.head = nn.Sequential(nn.Linear(config.dim, config.mlp), nn.GELU(), nn.Linear(config.mlp, config.outputs))

    def command(self, features: Tensor) -> Tensor:
        """Commands (M, outputs) from features of robots (M, ``config.dim``)."""
        out: Tensor = self.head(self.norm(features))
        return out

    def forward(self, inputs: Any) -> Tensor:
        """Commands (M, outputs)."""
        return self.command(self.encode(inputs)[1])


def to_device(array: NDArray[Any], device: torch.device | str) -> Tensor:
    """Move an array into PyTorch; on its way to a GPU nobody waits for it."""
    tensor = torch.from_numpy(array)
    if torch.device(device).type == "cuda":
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=True)
