"""The same network as it is commonly written: every patch of every map, through every layer."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from triform.policy import NetworkConfig, pack, vit_network
from triform.policy.vit import token_batch
from triform.policy.weights import load_policy
from triform.types import MapArray

#: Largest difference of two commands that count as equal [m/s].
TOLERANCE = 1e-4


class DenseBlock(nn.Module):
    """One pre-norm encoder layer on rows of equal length."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.norm_attention = nn.LayerNorm(config.dim)
        self.qkv = nn.Linear(config.dim, 3 * config.dim)
        self.project = nn.Linear(config.dim, config.dim)
        self.norm_mlp = nn.LayerNorm(config.dim)
        self.expand = nn.Linear(config.dim, config.mlp)
        self.contract = nn.Linear(config.mlp, config.dim)

    def forward(self, x: Tensor) -> Tensor:
        """Transform tokens, shape (M, L, D)."""
        maps, length, dim = x.shape
        qkv = self.qkv(self.norm_attention(x)).view(maps, length, 3, self.heads, dim // self.heads)
        queries, keys, values = qkv.permute(2, 0, 3, 1, 4).unbind(0)
        mixed = functional.scaled_dot_product_attention(queries, keys, values)
        x = x + self.project(mixed.transpose(1, 2).reshape(maps, length, dim))
        out: Tensor = x + self.contract(functional.gelu(self.expand(self.norm_mlp(x))))
        return out


class DenseTransformer(nn.Module):
    """The Vision Transformer of a policy without any packing; its parameters have the same names."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.embed = nn.Linear(config.patch**2, config.dim)
        self.position = nn.Parameter(torch.empty(config.patches + 1, config.dim))
        self.class_token = nn.Parameter(torch.zeros(config.dim))
        self.blocks = nn.ModuleList(DenseBlock(config) for _ in range(config.depth))
        self.norm = nn.LayerNorm(config.dim)
        self.head = nn.Sequential(nn.Linear(config.dim, config.mlp), nn.GELU(), nn.Linear(config.mlp, config.outputs))
        nn.init.normal_(self.position, std=0.02)

    def forward(self, patches: Tensor) -> Tensor:
        """Body twists (M, 3) from all patches of M maps, shape (M, P, patch * patch)."""
        first = self.class_token.expand(patches.shape[0], 1, -1)
        x = torch.cat([first, self.embed(patches)], dim=1) + self.position
        for block in self.blocks:
            x = block(x)
        out: Tensor = self.head(self.norm(x[:, 0]))
        return out


def all_patches(maps: MapArray, patch: int) -> NDArray[np.float32]:
    """All patches of maps (M, H, W), row-major, shape (M, P, patch * patch)."""
    count, rows, columns = maps.shape
    cut = maps.reshape(count, rows // patch, patch, columns // patch, patch).transpose(0, 1, 3, 2, 4)
    return cut.reshape(count, -1, patch * patch).astype(np.float32)


def dense_network(folder: Path) -> DenseTransformer:
    """The dense network with the weights of the policy in ``folder``.

    Raises:
        AssertionError: If it is another function than the policy's network that attends to every patch.
    """
    network, spec = load_policy(folder)
    shape = vit_network(spec.network)
    dense = DenseTransformer(shape).eval()
    dense.load_state_dict(network.state_dict())
    maps = (np.random.default_rng(0).random((2, spec.map.size, spec.map.size)) < 0.02).astype(np.uint8)
    patch = shape.patch
    with torch.inference_mode():
        difference = dense(torch.from_numpy(all_patches(maps, patch))) - network(token_batch(pack(maps, patch, "all")))
    assert float(difference.abs().max()) < TOLERANCE, "the dense network is another function"
    return dense


def dense_session(
    network: DenseTransformer, example: NDArray[np.float32], path: Path, threads: int
) -> onnxruntime.InferenceSession:
    """The dense network in ONNX Runtime, exported by PyTorch to ``path``; input ``patches``, shaped as ``example``.

    Raises:
        AssertionError: If it gives other commands than in PyTorch.
    """
    tensor = torch.from_numpy(example)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            (tensor,),
            str(path),
            input_names=["patches"],
            output_names=["commands"],
            dynamo=True,
            verbose=False,
        )
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    with torch.inference_mode():
        difference = session.run(None, {"patches": example})[0] - network(tensor).numpy()
    assert np.abs(difference).max() < TOLERANCE, "the exported network is another function"
    return session
