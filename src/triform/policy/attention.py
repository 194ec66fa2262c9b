"""Attention among the tokens of each map of a packed batch.

What the kernels write into belongs to PyTorch, which aligns its memory: some of its matrix products round differently
where memory begins elsewhere, and a resumed training would then no longer equal an uninterrupted one to the bit.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional
from torch.nn.attention import SDPBackend, sdpa_kernel

from triform.policy.ragged import attend, attend_backward, attention_scores


class Rows:
    """Which packed tokens attend to each other: the patches of a map and its class token.

    On the CPU, maps of different lengths go through kernels that need no padding, and so does all learning, because
    their gradients take half the time of PyTorch's. Elsewhere PyTorch's attention works on M rows of L slots; slot 0 of
    a row is the class token, and rows shorter than the longest end in slots that are masked.
    """

    def __init__(self, counts: Tensor, device: torch.device) -> None:
        """Lay out maps of ``counts`` patches, shape (M,), on the CPU, for tokens on ``device``."""
        self.maps = counts.shape[0]
        self._length = int(counts.max()) + 1 if self.maps else 1
        self._even = self.maps == 0 or int(counts.min()) + 1 == self._length
        kernels = device.type == "cpu" and (not self._even or torch.is_grad_enabled())
        self._lists = _token_lists(counts.numpy()) if kernels else None
        if self._lists is None:
            self._lay_out(counts, device)

    def _lay_out(self, counts: Tensor, device: torch.device) -> None:
        row = torch.repeat_interleave(torch.arange(self.maps), counts)
        first = torch.cumsum(counts, 0) - counts
        slot = torch.arange(row.shape[0]) - first[row] + 1
        flat = torch.cat([row * self._length + slot, torch.arange(self.maps) * self._length])
        filled = torch.arange(self._length)[None] <= counts[:, None]
        self._flat = flat.to(device)
        self._mask = None if self._even else filled[:, None, None, :].to(device)

    def attend(self, qkv: Tensor, heads: int) -> Tensor:
        """Self-attention of the tokens of each map: (K + M, 3D) -> (K + M, D)."""
        tokens, width = qkv.shape[0], qkv.shape[1] // (3 * heads)
        if self._lists is not None:
            mixed: Tensor = _SelfAttention.apply(  # type: ignore[no-untyped-call]
                qkv.view(tokens, 3 * heads, width), *self._lists
            )
            return mixed.view(tokens, heads * width)
        # (K + M, 3D) -> (3, M, heads, L, D / heads)
        queries, keys, values = self._spread(qkv).view(self.maps, self._length, 3, heads, width).permute(2, 0, 3, 1, 4)
        rows = self._attention(queries, keys, values, width**-0.5)
        return rows.transpose(1, 2).reshape(self.maps * self._length, heads * width)[self._flat]

    def read(self, probes: Tensor, tokens: Tensor, scale: float) -> Tensor:
        """Let the H probes of each map, (M, H, D), attend to its tokens, (K + M, D), as keys and as values."""
        if self._lists is not None:
            read: Tensor = _Reading.apply(  # type: ignore[no-untyped-call]
                probes, tokens, scale, *self._lists
            )
            return read
        slots = self._spread(tokens).view(self.maps, 1, self._length, tokens.shape[1])
        return self._attention(probes[:, None], slots, slots, scale)[:, 0]

    def _attention(self, queries: Tensor, keys: Tensor, values: Tensor, scale: float) -> Tensor:
        # On the CPU the fused kind multiplies row by row, and oneDNN takes longer to start than for such a product.
        plain = sdpa_kernel(SDPBackend.MATH) if queries.device.type == "cpu" else nullcontext()
        with plain:
            return functional.scaled_dot_product_attention(queries, keys, values, attn_mask=self._mask, scale=scale)

    def _spread(self, x: Tensor) -> Tensor:
        """(K + M, C) -> (M * L, C)."""
        return x.new_zeros(self.maps * self._length, x.shape[1]).index_copy(0, self._flat, x)


def _token_lists(counts: np.ndarray[Any, np.dtype[np.int64]]) -> tuple[Any, Any]:
    """For each map the indices of its patches and its class token, one map behind the other, and where each begins."""
    maps, patches = counts.shape[0], int(counts.sum())
    first = np.zeros(maps + 1, dtype=np.int64)
    np.cumsum(counts + 1, out=first[1:])
    owner = np.repeat(np.arange(maps), counts)
    tokens = np.empty(patches + maps, dtype=np.int64)
    tokens[np.arange(patches) + owner] = np.arange(patches)
    tokens[first[1:] - 1] = patches + np.arange(maps)
    return tokens, first


def _array(x: Tensor) -> np.ndarray[Any, Any]:
    return x.detach().contiguous().numpy()


def _mix(q: Any, k: Any, v: Any, layout: tuple[Any, ...], size: int, out: Any) -> Any:
    """Add attention to ``out`` and return its ``size`` weights, flat; arguments are those of ``attend_backward``."""
    q_rows, q_first, k_rows, k_first, heads, k_head, v_head, scale = layout
    weights = torch.empty(size, dtype=torch.from_numpy(q).dtype).numpy()
    attention_scores(q, k, q_rows, q_first, k_rows, k_first, heads, k_head, scale, weights)
    np.exp(weights, out=weights)
    attend(v, q_rows, q_first, k_rows, k_first, heads, v_head, weights, out)
    return weights


class _SelfAttention(torch.autograd.Function):
    """``Rows.attend`` on the CPU: queries, keys and values side by side, shape (K + M, 3 * heads, D / heads)."""

    @staticmethod
    def forward(ctx: Any, qkv: Tensor, tokens: Any, first: Any) -> Tensor:
        heads = qkv.shape[1] // 3
        # Under autocast they may come in reduced precision.
        x = _array(qkv.float() if qkv.dtype == torch.bfloat16 else qkv)
        lengths = np.diff(first)
        out = torch.zeros(x.shape[0], heads, x.shape[2], dtype=torch.from_numpy(x).dtype)
        layout = (tokens, first, tokens, first, heads, heads, 2 * heads, x.dtype.type(x.shape[2] ** -0.5))
        weights = _mix(x, x, x, layout, heads * int(lengths @ lengths), out.numpy())
        ctx.kept, ctx.dtype = (x, layout, weights), qkv.dtype
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, layout, weights = ctx.kept
        d_qkv = torch.zeros(x.shape, dtype=grad.dtype)
        d_x = d_qkv.numpy()
        attend_backward(x, x, x, *layout, weights, _array(grad), d_x, d_x, d_x)
        return d_qkv.to(ctx.dtype), None, None


class _Reading(torch.autograd.Function):
    """``Rows.read`` on the CPU: every probe is a query of its own, and there is one head of full width."""

    @staticmethod
    def forward(ctx: Any, probes: Tensor, tokens: Tensor, scale: float, lists: Any, first: Any) -> Tensor:
        maps, count, dim = probes.shape
        keys = _array(tokens.float() if tokens.dtype == torch.bfloat16 else tokens).reshape(-1, 1, dim)
        queries = _array(probes.to(torch.from_numpy(keys).dtype)).reshape(-1, 1, dim)
        query_lists = np.arange(maps * count), np.arange(maps + 1) * count
        out = torch.zeros(queries.shape, dtype=torch.from_numpy(queries).dtype)
        layout = (*query_lists, lists, first, 1, 0, 0, keys.dtype.type(scale))
        weights = _mix(queries, keys, keys, layout, count * int(first[-1]), out.numpy())
        ctx.kept, ctx.dtypes = (queries, keys, layout, weights), (probes.dtype, tokens.dtype)
        return out.view(maps, count, dim)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        queries, keys, layout, weights = ctx.kept
        d_probes, d_tokens = torch.zeros(queries.shape, dtype=grad.dtype), torch.zeros(keys.shape, dtype=grad.dtype)
        d_queries, d_keys = d_probes.numpy(), d_tokens.numpy()
        attend_backward(
            queries, keys, keys, *layout, weights, _array(grad).reshape(queries.shape), d_queries, d_keys, d_keys
        )
        probes_dtype, tokens_dtype = ctx.dtypes
        return d_probes.view(grad.shape).to(probes_dtype), d_tokens[:, 0].to(tokens_dtype), None, None, None
