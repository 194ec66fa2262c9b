"""Shape of a policy network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from triform.types import MapConfig, require


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of the Vision Transformer; the defaults are the paper's network.

    Attributes:
        map_size: Cells along each side of the occupancy map.
        patch: Cells along each side of a patch.
        dim: Embedding dimension D.
        depth: Encoder layers.
        heads: Attention heads.
        mlp: Hidden width of the encoder's and the output's MLPs.
        outputs: Numbers per command: u_x, u_y, omega.
        attention: ``occupied`` computes only the patches that hold something; ``all`` is the paper's own variant.
    """

    map_size: int = 100
    patch: int = 10
    dim: int = 256
    depth: int = 3
    heads: int = 8
    mlp: int = 512
    outputs: int = 3
    attention: Literal["occupied", "all"] = "occupied"

    def __post_init__(self) -> None:
        for name in ("map_size", "patch", "dim", "depth", "heads", "mlp", "outputs"):
            value = getattr(self, name)
            require(value >= 1, f"network {name} is {value}; it must be at least 1")
        require(
            self.map_size % self.patch == 0,
            f"a map of {self.map_size} cells does not divide into patches of {self.patch}",
        )
        require(self.dim % self.heads == 0, f"dim {self.dim} does not divide into {self.heads} heads")
        require(
            self.attention in ("occupied", "all"),
            f"attention is {self.attention!r}; it must be 'occupied' or 'all'",
        )

    @property
    def patches(self) -> int:
        """Patches of a whole map."""
        return (self.map_size // self.patch) ** 2

    def fits(self, config: MapConfig) -> bool:
        """Whether the network reads maps of this configuration."""
        return self.map_size == config.size
