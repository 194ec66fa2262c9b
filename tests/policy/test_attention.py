from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from triform.policy.attention import Rows

CPU = torch.device("cpu")


def rows_one_by_one(qkv: torch.Tensor, counts: list[int], heads: int) -> torch.Tensor:
    """PyTorch's attention, map by map."""
    out = torch.zeros(qkv.shape[0], qkv.shape[1] // 3, dtype=qkv.dtype)
    first = 0
    for m, count in enumerate(counts):
        index = torch.tensor([*range(first, first + count), sum(counts) + m])
        q, k, v = qkv[index].view(count + 1, 3, heads, -1).permute(1, 2, 0, 3).unbind(0)
        mixed = functional.scaled_dot_product_attention(q, k, v).transpose(0, 1).reshape(count + 1, -1)
        out = out.index_copy(0, index, mixed)
        first += count
    return out


def reading_one_by_one(probes: torch.Tensor, tokens: torch.Tensor, counts: list[int], scale: float) -> torch.Tensor:
    first, out = 0, []
    for m, count in enumerate(counts):
        index = torch.tensor([*range(first, first + count), sum(counts) + m])
        out.append((scale * probes[m] @ tokens[index].T).softmax(1) @ tokens[index])
        first += count
    return torch.stack(out)


def gradients(out: torch.Tensor, *inputs: torch.Tensor) -> list[torch.Tensor]:
    torch.manual_seed(1)
    return list(torch.autograd.grad((out * torch.randn_like(out)).sum(), inputs))


@settings(deadline=None, max_examples=25)
@given(
    counts=st.lists(st.integers(0, 9), min_size=1, max_size=6),
    heads=st.sampled_from([1, 2, 3]),
    width=st.sampled_from([1, 5, 16]),
    seed=st.integers(0, 100),
)
def test_rows_of_any_length_equal_pytorch_map_by_map(counts: list[int], heads: int, width: int, seed: int) -> None:
    torch.manual_seed(seed)
    tokens = sum(counts) + len(counts)
    rows = Rows(torch.tensor(counts), CPU)
    qkv = (2 * torch.randn(tokens, 3 * heads * width, dtype=torch.float64)).requires_grad_()
    found, wanted = rows.attend(qkv, heads), rows_one_by_one(qkv, counts, heads)
    torch.testing.assert_close(found, wanted)
    torch.testing.assert_close(gradients(found, qkv), gradients(wanted, qkv))
    probes = torch.randn(len(counts), heads, width, dtype=torch.float64, requires_grad=True)
    keys = torch.randn(tokens, width, dtype=torch.float64, requires_grad=True)
    found, wanted = rows.read(probes, keys, 0.7), reading_one_by_one(probes, keys, counts, 0.7)
    torch.testing.assert_close(found, wanted)
    torch.testing.assert_close(gradients(found, probes, keys), gradients(wanted, probes, keys))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_single_precision_is_kept_where_tokens_are_rounded(dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    counts = [3, 30, 0]
    qkv = (3 * torch.randn(36, 96)).to(dtype).requires_grad_()
    found = Rows(torch.tensor(counts), CPU).attend(qkv, 2)
    wanted = rows_one_by_one(qkv.double(), counts, 2).float()
    torch.testing.assert_close(found, wanted)
    # Rounded once, at the end.
    torch.testing.assert_close(gradients(found, qkv), gradients(wanted, qkv), rtol=1e-2, atol=1e-4)


def test_values_that_are_not_finite_do_not_vanish() -> None:
    qkv = torch.randn(6, 12)
    qkv[0, 0] = float("nan")
    assert Rows(torch.tensor([1, 3]), CPU).attend(qkv, 2).isnan().any()
