"""What the Vision Transformer looks at: its forward pass in NumPy, which keeps the attention.

The exported graph answers commands alone. The same weights are computed here once more, for one map, and the weights
with which the class token reads the patches in the last layer come out with the answer.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from triform.kernels import kernel
from triform.policy.checkpoint import PolicySpec, read_weights
from triform.policy.config import vit_network
from triform.policy.packing import PackedMaps
from triform.policy.tensors import read_tensors
from triform.types import FloatArray, TriformError, require

_Tensor = NDArray[np.float32]
#: What PyTorch adds to variances in its layer norms.
_EPSILON = np.float32(1e-5)


@kernel
def _gelu(x):
    """Apply GELU to every number of ``x`` in place."""
    flat = x.reshape(-1)
    for k in range(flat.shape[0]):
        flat[k] *= np.float32(0.5) * (np.float32(1.0) + math.erf(flat[k] / np.float32(math.sqrt(2.0))))


@kernel(fastmath={"reassoc", "contract", "nsz"})
def _product(x, weight, bias):
    """Return ``x W^T + b`` for rows ``x``, shape (rows, inputs) -> (rows, outputs).

    A page computes one map now and then, beside a simulation: threads of a BLAS would wait for busy cores.
    """
    out = np.empty((x.shape[0], weight.shape[0]), dtype=np.float32)
    for row in range(x.shape[0]):
        for column in range(weight.shape[0]):
            total = bias[column]
            for k in range(x.shape[1]):
                total += x[row, k] * weight[column, k]
            out[row, column] = total
    return out


class AttentionReader:
    """A stored Vision Transformer that says where it looks.

    Attributes:
        spec: Description of the policy.
    """

    def __init__(self, folder: Path) -> None:
        """Read the policy in ``folder``, exported or not.

        Raises:
            TriformError: The folder holds no policy, or its weights do not fit its description.
            ConfigurationError: Its network is no Vision Transformer.
        """
        self.spec: PolicySpec
        self.spec, weights = read_weights(folder)
        self._network = vit_network(self.spec.network)
        self._tensors = read_tensors(weights)
        expected = (self._network.patches + 1, self._network.dim)
        position = self._tensors.get("position")
        if position is None or position.shape != expected:
            raise TriformError(f"the weights in {folder} do not fit the network that its description names")

    def read(self, packed: PackedMaps) -> tuple[FloatArray, FloatArray]:
        """Return what the network answers to one map, and the attention behind it.

        Args:
            packed: One map, packed for the network.

        Returns:
            The network's numbers, shape (outputs,), and the weights with which the class token reads the patches in the
            last layer, mean over the heads, shape (P,) over all patches of the map. They sum to 1 with what the
            class token keeps of itself.

        Raises:
            ConfigurationError: There is not exactly one map.
        """
        require(len(packed.counts) == 1, f"{len(packed.counts)} maps given; attention is read of one")
        network, tensors = self._network, self._tensors
        patches = self._linear("embed", packed.patches.astype(np.float32)) + tensors["position"][1:][packed.positions]
        x = np.concatenate([patches, (tensors["class_token"] + tensors["position"][0])[None]])
        for layer in range(network.depth):
            # Only the class token is read in the end.
            queries = slice(None) if layer < network.depth - 1 else slice(len(x) - 1, None)
            x, weights = self._block(f"blocks.{layer}", x, queries)
        hidden = self._linear("head.0", self._norm("norm", x))
        _gelu(hidden)
        attention = np.zeros(network.patches)
        attention[packed.positions] = weights[:, 0, :-1].mean(axis=0)
        return self._linear("head.2", hidden)[0].astype(np.float64), attention

    def _block(self, name: str, x: _Tensor, queries: slice) -> tuple[_Tensor, _Tensor]:
        """One encoder layer for some of the tokens (L, D): them (l, D), and their attention (heads, l, L)."""
        network = self._network
        heads, width = network.heads, network.dim // network.heads
        qkv = self._linear(f"{name}.qkv", self._norm(f"{name}.norm_attention", x))
        # (L, 3 D) -> 3 of (heads, L, D / heads)
        query, key, value = qkv.reshape(len(x), 3, heads, width).transpose(1, 2, 0, 3)
        scores = np.einsum("hld,hkd->hlk", query[:, queries], key) / np.float32(math.sqrt(width))
        weights = np.exp(scores - scores.max(axis=-1, keepdims=True))
        weights /= weights.sum(axis=-1, keepdims=True)
        mixed = np.einsum("hlk,hkd->lhd", weights, value).reshape(-1, network.dim)
        x = x[queries] + self._linear(f"{name}.project", mixed)
        hidden = self._linear(f"{name}.expand", self._norm(f"{name}.norm_mlp", x))
        _gelu(hidden)
        return x + self._linear(f"{name}.contract", hidden), weights

    def _linear(self, name: str, x: _Tensor) -> _Tensor:
        weight, bias = self._tensors[f"{name}.weight"], self._tensors[f"{name}.bias"]
        product: _Tensor = _product(np.ascontiguousarray(x), weight, bias)
        return product

    def _norm(self, name: str, x: _Tensor) -> _Tensor:
        centred = x - x.mean(axis=-1, keepdims=True)
        scale = 1 / np.sqrt((centred**2).mean(axis=-1, keepdims=True) + _EPSILON)
        normed: _Tensor = centred * scale * self._tensors[f"{name}.weight"] + self._tensors[f"{name}.bias"]
        return normed
