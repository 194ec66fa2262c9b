"""A convolutional network on occupancy maps: a baseline for the Vision Transformer, trained on the same.

It reads the same packed patches and lays them out as whole maps. Its grid has one cell for every patch, so it predicts
the same auxiliary targets from the cells of occupied patches, and facts and commands from the whole grid.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from triform.policy.config import CnnConfig
from triform.policy.network import PolicyNetwork
from triform.policy.vit import TokenBatch


def dense_maps(tokens: TokenBatch, config: CnnConfig) -> tuple[Tensor, Tensor]:
    """Whole maps (M, 1, H, H) of packed patches, and the map of every patch (K,)."""
    maps, columns, patch = tokens.counts.shape[0], config.columns, config.patch
    owner = torch.repeat_interleave(torch.arange(maps), tokens.counts).to(tokens.patches.device)
    cells = tokens.patches.new_zeros(maps, config.patches, patch**2)
    cells[owner, tokens.positions] = tokens.patches
    # (M, rows of patches, columns of patches, rows of a patch, columns of a patch)
    grid = cells.view(maps, columns, columns, patch, patch).transpose(2, 3)
    return grid.reshape(maps, 1, config.map_size, config.map_size), owner


class ConvolutionalNetwork(PolicyNetwork):
    """Occupancy map -> command: strided convolutions, residual ones on the grid, an MLP on the whole grid."""

    def __init__(self, config: CnnConfig) -> None:
        super().__init__()
        self.config = config
        step, channels = config.patch // 2, config.channels
        self.look = nn.Conv2d(1, config.stem, step + 2, stride=step, padding=1)
        self.gather = nn.Conv2d(config.stem, channels, 3, stride=2, padding=1)
        self.mix = nn.ModuleList(nn.Conv2d(channels, channels, 3, padding=1) for _ in range(config.depth))
        self.squeeze = nn.Conv2d(channels, config.squeeze, 1)
        self.read = nn.Linear(config.squeeze * config.patches, config.dim)
        self.add_head(config)

    def encode(self, tokens: TokenBatch) -> tuple[Tensor, Tensor]:
        """Features of the packed patches (K, channels) and of the maps (M, D)."""
        maps, owner = dense_maps(tokens, self.config)
        # From M x 1 x H x H over a grid of half patches to that of patches, M x channels x columns x columns.
        x = functional.relu(self.gather(functional.relu(self.look(maps))))
        for layer in self.mix:
            x = x + functional.relu(layer(x))
        patches = x.flatten(2).transpose(1, 2)[owner, tokens.positions]
        return patches, self.read(functional.relu(self.squeeze(x)).flatten(1))
