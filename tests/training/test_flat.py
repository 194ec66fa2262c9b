from __future__ import annotations

import pytest
import torch
from torch import nn

from triform.training.flat import FlatParameters
from triform.training.precision import matrix_products, reduced


@pytest.mark.parametrize("clip", [0.0, 0.05, 1e6])
def test_one_vector_learns_like_the_parameters_one_by_one(clip: float) -> None:
    torch.manual_seed(0)
    nets = [nn.Sequential(nn.Linear(5, 7), nn.GELU(), nn.LayerNorm(7), nn.Linear(7, 2)) for _ in range(2)]
    nets[1].load_state_dict(nets[0].state_dict())
    plain = torch.optim.AdamW(nets[0].parameters(), lr=0.01, weight_decay=0.1)
    flat = FlatParameters(nets[1])
    optimizer = torch.optim.AdamW([flat.values], lr=0.01, weight_decay=0.1)
    for _ in range(20):
        x = torch.randn(11, 5)
        plain.zero_grad()
        nets[0](x).square().mean().backward()
        norm = nn.utils.clip_grad_norm_(nets[0].parameters(), clip or float("inf"))
        plain.step()
        flat.gradient.zero_()
        nets[1](x).square().mean().backward()
        torch.testing.assert_close(flat.clip(clip), norm)
        optimizer.step()
    for one, other in zip(nets[0].parameters(), nets[1].parameters(), strict=True):
        torch.testing.assert_close(one, other)


def test_precision_holds_inside_and_only_there() -> None:
    before = torch.get_float32_matmul_precision()
    x = torch.randn(8, 8)
    with matrix_products("medium"):
        assert torch.get_float32_matmul_precision() == "medium"
        with reduced("medium", x.device):
            assert (x @ x).dtype == torch.float32
        with reduced("bfloat16", x.device):
            assert (x @ x).dtype == torch.bfloat16
    with matrix_products("float32"):
        assert torch.get_float32_matmul_precision() == "highest"
    assert torch.get_float32_matmul_precision() == before
