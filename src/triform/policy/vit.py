"""The Vision Transformer of the paper, computed on the patches that hold something.

An occupancy map is empty nearly everywhere, and an empty patch carries nothing but its position. The network
therefore drops empty patches before the first layer: the same function as a dense ViT whose attention masks them,
at a fraction of the work. ``attention="all"`` is the paper's own network, which attends to every patch.

Tokens of all maps of a batch lie one after the other (K of them), the M class tokens behind them; only attention
needs them side by side in rows of equal length.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from triform.policy.config import NetworkConfig
from triform.policy.packing import PackedMaps


@dataclass(frozen=True)
class TokenBatch:
    """Patches of M maps, packed one behind the other.

    Attributes:
        patches: Cells of every patch, float, shape (K, patch * patch).
        positions: Index of every patch in its map, row-major, shape (K,).
        counts: Patches of every map, shape (M,), summing to K.
    """

    patches: Tensor
    positions: Tensor
    counts: Tensor


def token_batch(packed: PackedMaps, device: torch.device | str = "cpu") -> TokenBatch:
    """Move packed maps into PyTorch."""
    return TokenBatch(
        torch.from_numpy(packed.patches).to(device).float(),
        torch.from_numpy(packed.positions).to(device),
        torch.from_numpy(packed.counts).to(device),
    )


class Block(nn.Module):
    """One pre-norm encoder layer: multi-head self-attention and an MLP, each with a residual."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.norm_attention = nn.LayerNorm(config.dim)
        self.qkv = nn.Linear(config.dim, 3 * config.dim)
        self.project = nn.Linear(config.dim, config.dim)
        self.norm_mlp = nn.LayerNorm(config.dim)
        self.expand = nn.Linear(config.dim, config.mlp)
        self.contract = nn.Linear(config.mlp, config.dim)

    def forward(self, x: Tensor, rows: Rows) -> Tensor:
        """Transform tokens, shape (K + M, D)."""
        # (K + M, 3D) -> (3, M, heads, L, D / heads)
        queries, keys, values = rows.spread(self.qkv(self.norm_attention(x)), 3, self.heads)
        mixed = functional.scaled_dot_product_attention(queries, keys, values, attn_mask=rows.mask)
        x = x + self.project(rows.gather(mixed))
        hidden = functional.gelu(self.expand(self.norm_mlp(x)))
        out: Tensor = x + self.contract(hidden)
        return out


class Rows:
    """Where each packed token sits when the maps of a batch lie side by side, M rows of L slots.

    Slot 0 of a row is the class token; rows shorter than the longest end in slots that attention masks.
    """

    def __init__(self, counts: Tensor) -> None:
        self.maps = counts.shape[0]
        self.length = int(counts.max()) + 1 if self.maps else 1
        row = torch.repeat_interleave(torch.arange(self.maps, device=counts.device), counts)
        first = torch.cumsum(counts, 0) - counts
        slot = torch.arange(row.shape[0], device=counts.device) - first[row] + 1
        class_slots = torch.arange(self.maps, device=counts.device) * self.length
        self.flat = torch.cat([row * self.length + slot, class_slots])
        filled = torch.arange(self.length, device=counts.device)[None] <= counts[:, None]
        self.mask = None if bool(filled.all()) else filled[:, None, None, :]

    def spread(self, x: Tensor, parts: int, heads: int) -> tuple[Tensor, ...]:
        """(K + M, parts * D) -> ``parts`` tensors of shape (M, heads, L, D / heads)."""
        padded = x.new_zeros(self.maps * self.length, x.shape[1]).index_copy(0, self.flat, x)
        return (
            padded.view(self.maps, self.length, parts, heads, x.shape[1] // (parts * heads))
            .permute(2, 0, 3, 1, 4)
            .unbind(0)
        )

    def gather(self, x: Tensor) -> Tensor:
        """(M, heads, L, D / heads) -> (K + M, D)."""
        return x.transpose(1, 2).reshape(self.maps * self.length, x.shape[1] * x.shape[3])[self.flat]


class VisionTransformer(nn.Module):
    """Occupancy map -> body twist: patch embedding, encoder with class token, output MLP."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.embed = nn.Linear(config.patch**2, config.dim)
        self.position = nn.Parameter(torch.empty(config.patches + 1, config.dim))
        self.class_token = nn.Parameter(torch.zeros(config.dim))
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.depth))
        self.norm = nn.LayerNorm(config.dim)
        self.head = nn.Sequential(nn.Linear(config.dim, config.mlp), nn.GELU(), nn.Linear(config.mlp, config.outputs))
        nn.init.normal_(self.position, std=0.02)

    def encode(self, tokens: TokenBatch) -> tuple[Tensor, Tensor]:
        """Return the encoded patches (K, D) and the encoded class tokens (M, D)."""
        patches = self.embed(tokens.patches) + self.position[1:][tokens.positions]
        maps = tokens.counts.shape[0]
        x = torch.cat([patches, (self.class_token + self.position[0]).expand(maps, -1)])
        rows = Rows(tokens.counts)
        for block in self.blocks:
            x = block(x, rows)
        return x[: patches.shape[0]], x[patches.shape[0] :]

    def command(self, class_features: Tensor) -> Tensor:
        """Body twists (M, 3) from encoded class tokens (M, D)."""
        out: Tensor = self.head(self.norm(class_features))
        return out

    def forward(self, tokens: TokenBatch) -> Tensor:
        """Body twists (M, 3) of packed maps."""
        return self.command(self.encode(tokens)[1])
