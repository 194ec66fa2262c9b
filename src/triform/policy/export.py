"""From PyTorch to ONNX: the graph in ``model.onnx``, the weights still in ``model.safetensors``.

A safetensors file is a header followed by plain tensors, and ONNX may keep a tensor at an offset of another file. The
exported graph points there, so that a policy's weights exist once.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import struct
import warnings
from dataclasses import replace
from pathlib import Path

import onnx
import torch
from torch import Tensor, nn
from torch.nn import functional

from triform.files import sha256, write_atomically
from triform.policy.checkpoint import ONNX_FILE, SPEC_FILE, WEIGHTS_FILE
from triform.policy.vit import Block, VisionTransformer
from triform.policy.weights import load_policy
from triform.types import TriformError


class EqualRows(nn.Module):
    """The network on M maps that all keep the same number L of patches: no padding, no mask."""

    def __init__(self, network: VisionTransformer) -> None:
        super().__init__()
        self.network = network

    def forward(self, patches: Tensor, positions: Tensor) -> Tensor:
        """Body twists (M, 3) from patches (M, L, patch * patch) and their positions (M, L)."""
        network = self.network
        maps, kept, _ = patches.shape
        dim, length = network.config.dim, kept + 1
        x = network.embed(patches) + functional.embedding(positions + 1, network.position)
        first = (network.class_token + network.position[0]).expand(maps, 1, dim)
        x = torch.cat([first, x], dim=1)
        for block in network.blocks:
            assert isinstance(block, Block)
            qkv = block.qkv(block.norm_attention(x)).view(maps, length, 3, block.heads, dim // block.heads)
            queries, keys, values = qkv.permute(2, 0, 3, 1, 4).unbind(0)
            weights = torch.softmax(queries @ keys.transpose(-1, -2) * (dim // block.heads) ** -0.5, dim=-1)
            x = x + block.project((weights @ values).transpose(1, 2).reshape(maps, length, dim))
            x = x + block.contract(functional.gelu(block.expand(block.norm_mlp(x))))
        return network.command(x[:, 0])


def export_policy(folder: Path) -> Path:
    """Write ``model.onnx`` next to the weights of the policy in ``folder`` and return its path.

    Raises:
        TriformError: If the folder holds no policy or the file cannot be written.
    """
    network, spec = load_policy(folder)
    example = (torch.zeros(3, 5, spec.network.patch**2), torch.zeros(3, 5, dtype=torch.int64))
    maps, kept = torch.export.Dim("maps"), torch.export.Dim("kept")
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            EqualRows(network).eval(),
            example,
            input_names=["patches", "positions"],
            output_names=["commands"],
            dynamic_shapes=({0: maps, 1: kept}, {0: maps, 1: kept}),
            dynamo=True,
            # Folding constants would store transposed copies of the weights; ONNX Runtime folds them when it loads.
            optimize=False,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    drop_debug_records(model)
    point_into_safetensors(model, folder / WEIGHTS_FILE, prefix="network.")
    path, graph = folder / ONNX_FILE, model.SerializeToString()
    write_atomically(path, graph)
    write_atomically(folder / SPEC_FILE, replace(spec, onnx_sha256=sha256(graph)).to_json().encode())
    return path


def drop_debug_records(model: onnx.ModelProto) -> None:
    """Remove what the exporter noted for debugging, among it paths of this machine."""
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.initializer, *graph.value_info, *graph.input, *graph.output):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")


def point_into_safetensors(model: onnx.ModelProto, weights: Path, prefix: str) -> None:
    """Replace every weight stored in a model by a reference into a safetensors file beside it.

    Args:
        model: The model; changed in place. Its initializers are called ``prefix`` plus the tensor's name.
        weights: The safetensors file.
        prefix: What precedes a tensor's name in the model.

    Raises:
        TriformError: If a weight of the model is not, byte for byte, in the file.
    """
    content = weights.read_bytes()
    (header_length,) = struct.unpack_from("<Q", content)
    header = json.loads(content[8 : 8 + header_length])
    for tensor in model.graph.initializer:
        entry = header.get(tensor.name.removeprefix(prefix))
        begin, end = (8 + header_length + offset for offset in entry["data_offsets"]) if entry else (0, 0)
        if content[begin:end] != onnx.numpy_helper.to_array(tensor).tobytes():
            raise TriformError(f"the exported weight {tensor.name} does not stand in {weights}")
        tensor.ClearField("float_data")
        # ONNX's helper insists on raw data, which the reference replaces.
        tensor.raw_data = b""
        onnx.external_data_helper.set_external_data(tensor, weights.name, offset=begin, length=end - begin)
        tensor.ClearField("raw_data")
