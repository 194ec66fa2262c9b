from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from triform.policy import NetworkConfig, pack
from triform.policy.vit import VisionTransformer, token_batch
from triform.types import ConfigurationError

SMALL = NetworkConfig(map_size=20, patch=5, dim=16, depth=2, heads=4, mlp=24)


def some_maps(seed: int, count: int, size: int = 20, density: float = 0.02) -> np.ndarray:
    return (np.random.default_rng(seed).random((count, size, size)) < density).astype(np.uint8)


def network(config: NetworkConfig, seed: int = 0) -> VisionTransformer:
    torch.manual_seed(seed)
    net = VisionTransformer(config).double().eval()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return net


class MaskedDense(nn.Module):
    """The textbook network: every patch a token, torch's own attention with empty patches masked."""

    def __init__(self, net: VisionTransformer, mask_empty: bool) -> None:
        super().__init__()
        self.net = net
        self.mask_empty = mask_empty
        self.attention = nn.ModuleList()
        for block in net.blocks:
            layer = nn.MultiheadAttention(net.config.dim, net.config.heads, batch_first=True).double()
            layer.in_proj_weight.data = block.qkv.weight.data
            layer.in_proj_bias.data = block.qkv.bias.data
            layer.out_proj.weight.data = block.project.weight.data
            layer.out_proj.bias.data = block.project.bias.data
            self.attention.append(layer)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        net, patch = self.net, self.net.config.patch
        cut = maps.unfold(1, patch, patch).unfold(2, patch, patch).flatten(3).flatten(1, 2)
        tokens = net.embed(cut) + net.position[1:]
        first = (net.class_token + net.position[0]).expand(len(maps), 1, -1)
        x = torch.cat([first, tokens], 1)
        empty = torch.cat([torch.zeros(len(maps), 1, dtype=torch.bool), (cut == 0).all(-1)], 1)
        for block, attention in zip(net.blocks, self.attention, strict=True):
            normed = block.norm_attention(x)
            x = (
                x
                + attention(
                    normed, normed, normed, key_padding_mask=empty if self.mask_empty else None, need_weights=False
                )[0]
            )
            x = x + block.contract(nn.functional.gelu(block.expand(block.norm_mlp(x))))
        return net.head(net.norm(x[:, 0]))


def run(net: VisionTransformer, maps: np.ndarray) -> torch.Tensor:
    tokens = token_batch(pack(maps, net.config.patch, net.config.attention))
    return net(type(tokens)(tokens.patches.double(), tokens.positions, tokens.counts))


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.floats(0, 0.2))
def test_packed_equals_dense_with_empty_patches_masked(seed: int, count: int, density: float) -> None:
    net = network(SMALL)
    maps = some_maps(seed, count, density=density)
    with torch.no_grad():
        torch.testing.assert_close(
            run(net, maps), MaskedDense(net, True)(torch.from_numpy(maps).double()), rtol=1e-9, atol=1e-9
        )


def test_the_papers_variant_attends_to_every_patch() -> None:
    net = network(NetworkConfig(**{**vars(SMALL), "attention": "all"}))
    maps = some_maps(1, 4)
    with torch.no_grad():
        torch.testing.assert_close(
            run(net, maps), MaskedDense(net, False)(torch.from_numpy(maps).double()), rtol=1e-9, atol=1e-9
        )


def test_a_map_does_not_depend_on_the_others_of_its_batch() -> None:
    net = network(SMALL)
    maps = np.concatenate([some_maps(2, 5), np.zeros((1, 20, 20), np.uint8), some_maps(3, 2, density=0.5)])
    with torch.no_grad():
        together = run(net, maps)
        alone = torch.cat([run(net, maps[k : k + 1]) for k in range(len(maps))])
    torch.testing.assert_close(together, alone, rtol=1e-9, atol=1e-9)


def test_the_papers_network_has_its_shape() -> None:
    net = VisionTransformer(NetworkConfig())
    assert net.position.shape == (101, 256)
    assert len(net.blocks) == 3
    assert net.blocks[0].expand.out_features == 512
    assert net.head[-1].out_features == 3
    assert net.embed.in_features == 100


def test_gradients_reach_every_weight() -> None:
    net = VisionTransformer(SMALL)
    run_maps = token_batch(pack(some_maps(4, 6, density=0.3), 5))
    net(run_maps).square().sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name


@pytest.mark.parametrize(
    ("change", "says"),
    [({"patch": 7}, "divide"), ({"heads": 7}, "heads"), ({"dim": 0}, "dim"), ({"attention": "some"}, "attention")],
)
def test_impossible_shapes_are_refused(change: dict, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        NetworkConfig(**{**vars(SMALL), **change})
