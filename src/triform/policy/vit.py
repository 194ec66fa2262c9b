"""The Vision Transformer of the paper, computed on the patches that hold something.

An occupancy map is empty nearly everywhere, and an empty patch carries nothing but its position. The network
therefore drops empty patches before the first layer: the same function as a dense ViT whose attention masks them,
at a fraction of the work. ``attention="all"`` is the paper's own network, which attends to every patch.

Tokens of all maps of a batch lie one after the other (K of them), the M class tokens behind them; only attention
needs them side by side in rows of equal length.

Only the class token is read in the end, so the last layer is computed for it alone: the same function again, with
about a third of the paper's network less to compute.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from triform.policy.attention import Rows
from triform.policy.config import NetworkConfig
from triform.policy.network import PolicyNetwork, to_device
from triform.policy.packing import PackedMaps


@dataclass(frozen=True)
class TokenBatch:
    """Patches of M maps, packed one behind the other.

    Attributes:
        patches: Cells of every patch, float, shape (K, patch * patch).
        positions: Index of every patch in its map, row-major, shape (K,).
        counts: Patches of every map, shape (M,), summing to K; always on the CPU, where rows are laid out.
    """

    patches: Tensor
    positions: Tensor
    counts: Tensor


def token_batch(packed: PackedMaps, device: torch.device | str = "cpu") -> TokenBatch:
    """Move packed maps into PyTorch."""
    patches, positions = (to_device(array, device) for array in (packed.patches, packed.positions))
    return TokenBatch(patches.float(), positions, torch.from_numpy(packed.counts))


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
        x = x + self.project(rows.attend(self.qkv(self.norm_attention(x)), self.heads))
        return self._mlp(x)

    def read_out(self, x: Tensor, rows: Rows) -> Tensor:
        """Transform the class tokens alone: what ``forward`` gives in their place, shape (M, D).

        The score of head h for token y is ``q_h . (W_h y + b_h) = (W_h^T q_h) . y + const``, and its output is
        ``V_h sum_j(a_j y_j) + c_h``, as the weights a_j sum to one: with one query per map, keys and values need not
        be computed token by token.
        """
        maps, dim = rows.maps, x.shape[1]
        normed = self.norm_attention(x)
        to_query, to_key, to_value = self.qkv.weight.view(3, self.heads, dim // self.heads, dim)
        query_bias, _, value_bias = self.qkv.bias.view(3, dim)
        first = x.shape[0] - maps
        # (heads, M, D / heads) -> (M, heads, D): one probe per head
        queries = functional.linear(normed[first:], to_query.reshape(dim, dim), query_bias)
        probes = (queries.view(maps, self.heads, dim // self.heads).transpose(0, 1) @ to_key).transpose(0, 1)
        mixed = rows.read(probes, normed, (dim // self.heads) ** -0.5)
        values = (mixed.transpose(0, 1) @ to_value.transpose(1, 2)).transpose(0, 1).reshape(maps, dim)
        return self._mlp(x[first:] + self.project(values + value_bias))

    def _mlp(self, x: Tensor) -> Tensor:
        out: Tensor = x + self.contract(functional.gelu(self.expand(self.norm_mlp(x))))
        return out


class VisionTransformer(PolicyNetwork):
    """Occupancy map -> body twist: patch embedding, encoder with class token, output MLP."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.embed = nn.Linear(config.patch**2, config.dim)
        self.position = nn.Parameter(torch.empty(config.patches + 1, config.dim))
        self.class_token = nn.Parameter(torch.zeros(config.dim))
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.depth))
        self.add_head(config)
        nn.init.normal_(self.position, std=0.02)

    def encode(self, tokens: TokenBatch) -> tuple[Tensor, Tensor]:
        """Return the patches as they enter the last layer (K, D) and the class tokens as they leave it (M, D)."""
        patches = self.embed(tokens.patches) + self.position[1:][tokens.positions]
        maps = tokens.counts.shape[0]
        x = torch.cat([patches, (self.class_token + self.position[0]).expand(maps, -1)])
        rows = Rows(tokens.counts, x.device)
        for block in self.blocks[:-1]:
            x = block(x, rows)
        return x[: patches.shape[0]], cast(Block, self.blocks[-1]).read_out(x, rows)
