"""Auxiliary targets on patch tokens, used in training only.

Every occupied patch also predicts, for the robot nearest to the centroid of its occupied cells: that robot's term of
the teacher's sum, where its centre lies and whether it is a Gabriel neighbour. The truth behind a scan is known while
training, and this tells each token what the command's sum is made of. The head is thrown away afterwards.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from triform.policy import PackedMaps
from triform.types import FloatArray, MapConfig

#: Numbers predicted per token: term of the sum (2), centre offset (2), logit of being a neighbour (1).
TARGETS = 5
_OFFSET_SCALE = 0.2
_REACH = 0.45


@njit(cache=True, nogil=True)
def _token_targets(  # type: ignore[no-untyped-def]
    patches, positions, counts, neighbours, patch, columns, cell, half, distance, odd_gain, out, valid
):
    token = 0
    for m in range(counts.shape[0]):
        for _ in range(counts[m]):
            x_sum, y_sum, cells = 0.0, 0.0, 0
            for c in range(patch * patch):
                if patches[token, c]:
                    x_sum += (positions[token] // columns) * patch + c // patch
                    y_sum += (positions[token] % columns) * patch + c % patch
                    cells += 1
            valid[token] = False
            if cells > 0:
                x = (x_sum / cells + 0.5) * cell - half
                y = (y_sum / cells + 0.5) * cell - half
                nearest, best = -1, _REACH * _REACH
                for j in range(neighbours.shape[1]):
                    d_x, d_y = neighbours[m, j, 0] - x, neighbours[m, j, 1] - y
                    if d_x * d_x + d_y * d_y < best:
                        best = d_x * d_x + d_y * d_y
                        nearest = j
                if nearest >= 0:
                    q_x, q_y = neighbours[m, nearest, 0], neighbours[m, nearest, 1]
                    edge = neighbours[m, nearest, 2]
                    length = np.sqrt(q_x * q_x + q_y * q_y) + 1e-9
                    strain = edge * (length - distance) / length
                    out[token, 0] = strain * (q_x - odd_gain * q_y)
                    out[token, 1] = strain * (q_y + odd_gain * q_x)
                    out[token, 2] = (q_x - x) / _OFFSET_SCALE
                    out[token, 3] = (q_y - y) / _OFFSET_SCALE
                    out[token, 4] = edge
                    valid[token] = True
            token += 1


def token_targets(
    packed: PackedMaps, neighbours: FloatArray, config: MapConfig, patch: int, distance: float, odd_gain: float = 0.0
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Targets of every token and which tokens have any.

    Args:
        packed: Packed maps, K tokens of M maps.
        neighbours: For each map the other robots in the body frame, (x [m], y [m], is a Gabriel neighbour), shape
            (M, N - 1, 3).
        config: Configuration of the maps.
        patch: Cells along each side of a patch.
        distance: Prescribed neighbour distance d* [m].
        odd_gain: Gain of the teacher's odd spring over that of its spring.

    Returns:
        Targets (K, 5) and a mask (K,).
    """
    tokens = packed.patches.shape[0]
    targets = np.zeros((tokens, TARGETS), dtype=np.float32)
    valid = np.zeros(tokens, dtype=np.bool_)
    _token_targets(
        packed.patches,
        packed.positions,
        packed.counts,
        neighbours,
        patch,
        config.size // patch,
        config.cell,
        config.half_extent,
        distance,
        odd_gain,
        targets,
        valid,
    )
    return targets, valid


class AuxiliaryHead(nn.Module):
    """Predicts the targets of a token from its encoding."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.LayerNorm(dim), nn.Linear(dim, dim), nn.GELU(), nn.Linear(dim, TARGETS))

    def forward(self, features: Tensor) -> Tensor:
        """Predicted targets (K, 5) of encoded tokens (K, D)."""
        out: Tensor = self.layers(features)
        return out


def auxiliary_loss(predicted: Tensor, targets: Tensor, valid: Tensor) -> Tensor:
    """Sum of the losses of the tokens that have targets; predicted and targets (K, 5), valid (K,)."""
    squares = (predicted[:, :4] - targets[:, :4]).square()
    edge = functional.binary_cross_entropy_with_logits(predicted[:, 4], targets[:, 4], reduction="none")
    each = squares[:, :2].mean(1) + 0.1 * squares[:, 2:].mean(1) + 0.1 * edge
    # Not a product with the mask: a token without targets must not count even where its loss overflows.
    return torch.where(valid, each, 0.0).sum()
