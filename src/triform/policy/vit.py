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
        probes = (queries.view(maps, self.heads, -1).transpose(0, 1) @ to_key).transpose(0, 1)
        (tokens,) = rows.spread(normed, 1, 1)
        # The heads take the place of the queries, and all share the same keys and values: (M, 1, heads, D)
        mixed = functional.scaled_dot_product_attention(
            probes[:, None], tokens, tokens, attn_mask=rows.mask, scale=(dim // self.heads) ** -0.5
        )
        values = (mixed[:, 0].transpose(0, 1) @ to_value.transpose(1, 2)).transpose(0, 1).reshape(maps, dim)
        return self._mlp(x[first:] + self.project(values + value_bias))

    def _mlp(self, x: Tensor) -> Tensor:
        out: Tensor = x + self.contract(functional.gelu(self.expand(self.norm_mlp(x))))
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
        """Return the patches as they enter the last layer (K, D) and the class tokens as they leave it (M, D)."""
        patches = self.embed(tokens.patches) + self.position[1:][tokens.positions]
        maps = tokens.counts.shape[0]
        x = torch.cat([patches, (self.class_token + self.position[0]).expand(maps, -1)])
        rows = Rows(tokens.counts)
        for block in self.blocks[:-1]:
            x = block(x, rows)
        return x[: patches.shape[0]], self.blocks[-1].read_out(x, rows)

    def command(self, class_features: Tensor) -> Tensor:
        """Body twists (M, 3) from encoded class tokens (M, D)."""
        out: Tensor = self.head(self.norm(class_features))
        return out

    def forward(self, tokens: TokenBatch) -> Tensor:
        """Body twists (M, 3) of packed maps."""
        return self.command(self.encode(tokens)[1])
