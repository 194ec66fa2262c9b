"""Auxiliary targets, used in training only.

Every occupied patch also predicts, for the robot nearest to the centroid of its occupied cells: that robot's term of
the teacher's sum, where its centre lies, whether it is a Gabriel neighbour and whether it shares one with the robot
that looks. The truth behind a scan is known while training, and this tells each token what the command's sum is made
of. For the triangulating law the class token also predicts the features on which its decisions hang. The heads are
thrown away afterwards. The edges of a graph network predict the same of their senders, whose places they are told.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from triform.dataset import TeamLabels
from triform.kernels import kernel
from triform.policy import PackedMaps
from triform.types import FloatArray, MapConfig

#: Numbers predicted per token: term of the sum (2), centre offset (2), logits of being a neighbour and of sharing one.
TARGETS = 6
#: Facts that are shares, predicted as logits; the others are velocities.
_GATES = 3
_OFFSET_SCALE = 0.2
_REACH = 0.45


@kernel
def _token_targets(patches, positions, counts, seen, patch, columns, cell, half, out, valid):
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
                for j in range(seen.shape[1]):
                    d_x, d_y = seen[m, j, 0] - x, seen[m, j, 1] - y
                    if d_x * d_x + d_y * d_y < best:
                        best = d_x * d_x + d_y * d_y
                        nearest = j
                if nearest >= 0:
                    out[token, 0], out[token, 1] = seen[m, nearest, 2], seen[m, nearest, 3]
                    out[token, 2] = (seen[m, nearest, 0] - x) / _OFFSET_SCALE
                    out[token, 3] = (seen[m, nearest, 1] - y) / _OFFSET_SCALE
                    out[token, 4], out[token, 5] = seen[m, nearest, 4], seen[m, nearest, 5]
                    valid[token] = True
            token += 1


def token_targets(
    packed: PackedMaps, seen: FloatArray, config: MapConfig, patch: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Targets of every token and which tokens have any.

    Args:
        packed: Packed maps, K tokens of M maps.
        seen: The robots around each map's own, as ``triform.dataset`` describes them: x, y, term (2), is a neighbour,
            shares one, shape (M, S, 6).
        config: Configuration of the maps.
        patch: Cells along each side of a patch.

    Returns:
        Targets (K, TARGETS) and a mask (K,).
    """
    tokens = packed.patches.shape[0]
    targets = np.zeros((tokens, TARGETS), dtype=np.float32)
    valid = np.zeros(tokens, dtype=np.bool_)
    columns = config.size // patch
    _token_targets(
        packed.patches, packed.positions, packed.counts, seen, patch, columns, config.cell, config.half_extent,
        targets, valid,
    )  # fmt: skip
    return targets, valid


def edge_targets(labels: TeamLabels) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Targets of every edge of a graph network (E, TARGETS) and which edges have any (E,)."""
    targets = np.zeros((len(labels.seen), TARGETS), dtype=np.float32)
    targets[:, :2], targets[:, 4:] = labels.edge_features[:, :2], labels.edge_features[:, 2:]
    return targets, labels.seen


class AuxiliaryHead(nn.Module):
    """Predicts the targets of a token from its encoding, or the features of a map from its class token's."""

    def __init__(self, dim: int, outputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.LayerNorm(dim), nn.Linear(dim, dim), nn.GELU(), nn.Linear(dim, outputs))

    def forward(self, features: Tensor) -> Tensor:
        """Predicted numbers (K, outputs) of encoded tokens (K, D)."""
        out: Tensor = self.layers(features)
        return out


def token_loss(predicted: Tensor, targets: Tensor, valid: Tensor) -> Tensor:
    """Sum of the losses of the tokens that have targets; predicted and targets (K, TARGETS), valid (K,)."""
    squares = (predicted[:, :4] - targets[:, :4]).square()
    logits = functional.binary_cross_entropy_with_logits(predicted[:, 4:], targets[:, 4:], reduction="none")
    each = squares[:, :2].mean(1) + 0.1 * squares[:, 2:].mean(1) + 0.1 * logits.sum(1)
    # Not a product with the mask: a token without targets must not count even where its loss overflows.
    return torch.where(valid, each, 0.0).sum()


def feature_loss(predicted: Tensor, features: Tensor) -> Tensor:
    """Sum over maps of the losses of the features of the triangulating law, both (M, LAW_FEATURES)."""
    gates = functional.binary_cross_entropy_with_logits(predicted[:, :_GATES], features[:, :_GATES], reduction="none")
    return (0.1 * gates.sum(1) + 0.1 * (predicted[:, _GATES:] - features[:, _GATES:]).square().sum(1)).sum()
