"""The forward pass that keeps the attention against the exported graph, and the attention against PyTorch's."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from triform.control import shipped_weights
from triform.policy import AttentionReader, NetworkConfig, PolicyRuntime, pack, read_spec
from triform.policy.weights import load_policy
from triform.types import ConfigurationError, MapArray

TRANSFORMERS = [
    name for name, folder in shipped_weights().items() if isinstance(read_spec(folder).network, NetworkConfig)
]


def some_maps(size: int, count: int) -> MapArray:
    """Maps with a few blobs each; the last one is empty."""
    rng, maps = np.random.default_rng(5), np.zeros((count, size, size), dtype=np.uint8)
    for one in maps[:-1]:
        for row, column in rng.integers(4, size - 8, (rng.integers(1, 8), 2)):
            one[row : row + 4, column : column + 5] = 1
    return maps


@pytest.mark.parametrize("name", TRANSFORMERS)
def test_it_answers_what_the_policy_answers(name: str) -> None:
    folder = shipped_weights()[name]
    reader, runtime = AttentionReader(folder), PolicyRuntime(folder)
    network = reader.spec.network
    assert isinstance(network, NetworkConfig)
    for one in some_maps(network.map_size, 6):
        packed = pack(one[None], network.patch, network.attention)
        answer, attention = reader.read(packed)
        np.testing.assert_allclose(answer, runtime.commands(packed)[0], atol=2e-5)
        assert attention.min() >= 0.0
        assert attention.sum() < 1.0 + 1e-6
        # What holds nothing gets nothing, except of a network that reads all patches.
        assert set(np.flatnonzero(attention)) <= set(packed.positions.tolist())


def test_its_attention_is_that_of_pytorch() -> None:
    folder = shipped_weights()["near"]
    reader, (network, spec) = AttentionReader(folder), load_policy(folder)
    shape = spec.network
    assert isinstance(shape, NetworkConfig)
    one = some_maps(shape.map_size, 2)[:1]
    packed = pack(one, shape.patch)
    with torch.inference_mode():
        x = torch.cat(
            [
                network.embed(torch.from_numpy(packed.patches).float()) + network.position[1:][packed.positions],
                (network.class_token + network.position[0])[None],
            ]
        )
        for number, block in enumerate(network.blocks):
            own = torch.nn.MultiheadAttention(shape.dim, shape.heads, batch_first=True)
            own.in_proj_weight.copy_(block.qkv.weight)
            own.in_proj_bias.copy_(block.qkv.bias)
            own.out_proj.load_state_dict(block.project.state_dict())
            normed = block.norm_attention(x)[None]
            mixed, weights = own(normed, normed, normed)
            x = x + mixed[0]
            if number < shape.depth - 1:
                x = x + block.contract(torch.nn.functional.gelu(block.expand(block.norm_mlp(x))))
    _, attention = reader.read(packed)
    np.testing.assert_allclose(attention[packed.positions], weights[0, -1, :-1].numpy(), atol=1e-5)


def test_other_networks_and_several_maps_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="Vision Transformer is needed"):
        AttentionReader(shipped_weights()["cnn"])
    reader = AttentionReader(shipped_weights()["near"])
    with pytest.raises(ConfigurationError, match="2 maps given"):
        reader.read(pack(some_maps(100, 2), 10))
