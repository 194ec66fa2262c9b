"""Floating-point operations of a network, counted by PyTorch while it runs."""

from __future__ import annotations

import functools

import torch
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.peers.dense import DenseTransformer
from triform.policy import NetworkConfig, PackedMaps
from triform.policy.vit import TokenBatch, VisionTransformer


def _count(network: nn.Module, *inputs: object) -> int:
    # Attention as plain products, which the counter knows on every processor.
    with torch.inference_mode(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        network(*inputs)
    return int(counter.get_total_flops())


@functools.cache
def _one_map(config: NetworkConfig, patches: int) -> int:
    network = VisionTransformer(config).eval()
    cells = torch.zeros(patches, config.patch**2)
    return _count(network, TokenBatch(cells, torch.zeros(patches, dtype=torch.int64), torch.tensor([patches])))


@functools.cache
def _one_map_plain(config: NetworkConfig, patches: int) -> int:
    network = DenseTransformer(config).eval()
    network.position = nn.Parameter(torch.zeros(patches + 1, config.dim))
    return _count(network, torch.zeros(1, patches, config.patch**2))


def packed_flops(config: NetworkConfig, packed: PackedMaps) -> float:
    """Operations of the products that the network really needs for packed maps."""
    return float(sum(_one_map(config, int(count)) for count in packed.counts))


def plain_flops(config: NetworkConfig, packed: PackedMaps) -> float:
    """The same for a network that computes every layer for every occupied patch."""
    return float(sum(_one_map_plain(config, int(count)) for count in packed.counts))


def dense_flops(config: NetworkConfig) -> float:
    """Operations of the dense network for one map."""
    return float(_one_map_plain(config, config.patches))
