"""The ONNX graph of the network, written node by node from its shape; the weights stay in the safetensors file.

The function is that of ``vit.VisionTransformer``, arranged for single robots and small batches on a processor:

- All M maps of a call keep the same number of patches, so nothing is padded or masked. Slot 0 of a map's L slots is its
  class token: an empty patch at the extra position ``config.patches``.
- Tokens are rows of one matrix; every linear layer is one ``Gemm`` with its bias, on weights as PyTorch stores them.
- The last layer is computed for the class tokens alone, see ``Block.read_out``.

A safetensors file is a header followed by plain tensors, and ONNX may keep a tensor at an offset of another file. The
graph points there, so that a policy's weights exist once.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from onnx.external_data_helper import set_external_data

from triform.policy.config import Network, NetworkConfig
from triform.policy.tensors import tensor_table
from triform.types import TriformError

#: Of ONNX's operators; the first with ``Attention``.
OPSET = 23
_IR_VERSION = 11
#: What PyTorch adds to variances in its layer norms.
_EPSILON = 1e-5


class Graph:
    """Nodes and tensors of a graph under construction; every method returns the name of a tensor."""

    def __init__(self, weights: bytes, file_name: str) -> None:
        self._header, self._data_start = tensor_table(weights)
        self._file_name = file_name
        self.nodes: list[onnx.NodeProto] = []
        self.tensors: dict[str, onnx.TensorProto] = {}

    def op(self, kind: str, *inputs: str, outputs: int = 1, name: str | None = None, **attributes: Any) -> Any:
        """Append a node; returns the name of its output, ``name`` if given, or a list of them."""
        names = [name or f"{kind.lower()}_{len(self.nodes)}_{k}" for k in range(outputs)]
        self.nodes.append(helper.make_node(kind, list(inputs), names, **attributes))
        return names[0] if outputs == 1 else names

    def constant(self, name: str, value: Any) -> str:
        """A small tensor kept in the graph."""
        self.tensors.setdefault(name, numpy_helper.from_array(np.asarray(value), name))
        return name

    def weight(self, name: str, *shape: int, part: int = 0, parts: int = 1) -> str:
        """Part ``part`` of ``parts`` of a weight, in its stored order but with another shape; not copied.

        Raises:
            TriformError: If the weight does not have that many numbers, or there is none of that name.
        """
        entry = self._header.get(name)
        count = math.prod(shape)
        if entry is None or entry["dtype"] != "F32" or math.prod(entry["shape"]) != count * parts:
            raise TriformError(f"the weights do not fit the network: {name} should hold {count * parts} numbers")
        tensor = onnx.TensorProto(name=f"{name}:{part}/{parts}", data_type=TensorProto.FLOAT, dims=shape)
        # ONNX's helper insists on raw data, which the reference replaces.
        tensor.raw_data = b""
        begin = self._data_start + entry["data_offsets"][0] + 4 * count * part
        set_external_data(tensor, self._file_name, offset=begin, length=4 * count)
        tensor.ClearField("raw_data")
        self.tensors.setdefault(tensor.name, tensor)
        return str(tensor.name)

    def linear(self, name: str, x: str, inputs: int, outputs: int, part: int = 0, parts: int = 1) -> str:
        """``x W^T + b`` for rows ``x``, shape (rows, inputs) -> (rows, outputs)."""
        weight = self.weight(f"{name}.weight", outputs, inputs, part=part, parts=parts)
        bias = self.weight(f"{name}.bias", outputs, part=part, parts=parts)
        return str(self.op("Gemm", x, weight, bias, transB=1))

    def norm(self, name: str, x: str, dim: int) -> str:
        """Layer norm of rows."""
        scale, bias = self.weight(f"{name}.weight", dim), self.weight(f"{name}.bias", dim)
        return str(self.op("LayerNormalization", x, scale, bias, axis=-1, epsilon=_EPSILON))

    def head(self, x: str, config: Network) -> str:
        """The layers of ``PolicyNetwork.command``: features (rows, D) to commands (rows, outputs)."""
        hidden = self.linear("head.0", self.norm("norm", x, config.dim), config.dim, config.mlp)
        return self.linear("head.2", self.op("Gelu", hidden), config.mlp, config.outputs)

    def reshape(self, x: str, *shape: int) -> str:
        """Give ``x`` a shape known now."""
        return str(self.op("Reshape", x, self.constant(f"shape_{'_'.join(map(str, shape))}", np.array(shape))))

    def model(self, inputs: dict[str, tuple[Any, Any]], rows: str, outputs: int) -> bytes:
        """Finish: the graph as a serialised model.

        Args:
            inputs: Element type and shape of every input by name.
            rows: What a row of its output ``commands`` belongs to.
            outputs: Numbers per command.
        """
        given = [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in inputs.items()]
        commands = helper.make_tensor_value_info("commands", TensorProto.FLOAT, [rows, outputs])
        model = helper.make_model(
            helper.make_graph(self.nodes, "triform policy", given, [commands], list(self.tensors.values())),
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=_IR_VERSION,
            producer_name="triform",
        )
        return bytes(model.SerializeToString())

    def mlp(self, name: str, x: str, config: NetworkConfig) -> str:
        """The MLP of a layer with its residual."""
        dim = config.dim
        hidden = self.linear(f"{name}.expand", self.norm(f"{name}.norm_mlp", x, dim), dim, config.mlp)
        return str(self.op("Add", x, self.linear(f"{name}.contract", self.op("Gelu", hidden), config.mlp, dim)))


def _embed(graph: Graph, config: NetworkConfig) -> str:
    """Tokens (M * L, D) from the graph's inputs."""
    # Position 0 of the stored table belongs to the class token, which has no patch and so no bias of the embedding.
    table = graph.weight("position", config.patches + 1, config.dim)
    first = graph.op("Add", graph.weight("class_token", config.dim), graph.op("Gather", table, graph.constant("0", 0)))
    rest = graph.op(
        "Add",
        graph.weight("embed.bias", config.dim),
        graph.op("Slice", table, graph.constant("[1]", [1]), graph.constant("[end]", [config.patches + 1])),
    )
    places = graph.op("Concat", rest, graph.reshape(first, 1, config.dim), axis=0)
    offsets = graph.reshape(graph.op("Gather", places, "positions"), -1, config.dim)
    patches = graph.reshape("patches", -1, config.patch**2)
    weight = graph.weight("embed.weight", config.dim, config.patch**2)
    return str(graph.op("Gemm", patches, weight, offsets, transB=1))


def _layer(graph: Graph, name: str, x: str, config: NetworkConfig, maps: str) -> str:
    """One encoder layer: tokens (M * L, D) to the same."""
    dim = config.dim
    qkv = graph.linear(f"{name}.qkv", graph.norm(f"{name}.norm_attention", x, dim), dim, 3 * dim)
    rows = graph.op("Reshape", qkv, graph.op("Concat", maps, graph.constant("slots_3d", [-1, 3 * dim]), axis=0))
    queries, keys, values = graph.op("Split", rows, outputs=3, axis=2, num_outputs=3)
    heads = config.heads
    mixed = graph.reshape(graph.op("Attention", queries, keys, values, q_num_heads=heads, kv_num_heads=heads), -1, dim)
    return graph.mlp(name, graph.op("Add", x, graph.linear(f"{name}.project", mixed, dim, dim)), config)


def _by_head(graph: Graph, x: str, matrices: str) -> str:
    """Multiply every head's rows by its own matrix: (M, heads, a) and (heads, a, b) to (M, heads, b).

    A row of zeros is added for the time: ONNX Runtime sums a single row in another order than several, and a map's
    command must be the same to the bit whatever other maps are in the batch.
    """
    by_head = graph.op("Transpose", x, perm=[1, 0, 2])
    padded = graph.op("Pad", by_head, graph.constant("one_row", [0, 0, 0, 0, 1, 0]))
    product = graph.op("Transpose", graph.op("MatMul", padded, matrices), perm=[1, 0, 2])
    return str(graph.op("Slice", product, graph.constant("[0]", [0]), graph.constant("[-1]", [-1])))


def _read_out(graph: Graph, name: str, x: str, config: NetworkConfig, maps: str) -> str:
    """The last layer, for the class tokens alone: tokens (M * L, D) to (M, D); see ``Block.read_out``."""
    dim, heads = config.dim, config.heads
    width = dim // heads
    slots = graph.op("Concat", maps, graph.constant("slots_d", [-1, dim]), axis=0)
    tokens = graph.op("Reshape", graph.norm(f"{name}.norm_attention", x, dim), slots)
    zero = graph.constant("0", 0)
    normed = graph.op("Gather", tokens, zero, axis=1)
    x = graph.op("Gather", graph.op("Reshape", x, slots), zero, axis=1)
    queries = graph.reshape(graph.linear(f"{name}.qkv", normed, dim, dim, part=0, parts=3), -1, heads, width)
    to_key = graph.weight(f"{name}.qkv.weight", heads, width, dim, part=1, parts=3)
    to_value = graph.weight(f"{name}.qkv.weight", heads, width, dim, part=2, parts=3)
    # (M, heads, D / heads) x (heads, D / heads, D) -> (M, heads, D)
    probes = _by_head(graph, queries, to_key)
    scores = graph.op("MatMul", probes, graph.op("Transpose", tokens, perm=[0, 2, 1]))
    scaled = graph.op("Mul", scores, graph.constant("scale", np.float32(width**-0.5)))
    mixed = graph.op("MatMul", graph.op("Softmax", scaled, axis=-1), tokens)
    # (M, heads, D) x (heads, D, D / heads) -> (M, heads, D / heads)
    values = graph.reshape(_by_head(graph, mixed, graph.op("Transpose", to_value, perm=[0, 2, 1])), -1, dim)
    biased = graph.op("Add", values, graph.weight(f"{name}.qkv.bias", dim, part=2, parts=3))
    return graph.mlp(name, graph.op("Add", x, graph.linear(f"{name}.project", biased, dim, dim)), config)


def build_graph(graph: Graph, config: NetworkConfig) -> bytes:
    """Finish ``graph`` as the network of shape ``config``; see ``kinds.write_graph``.

    Inputs are ``patches``, float32 (M, L, patch * patch), and ``positions``, int64 (M, L), of M maps with L - 1
    patches each behind the class token's empty patch at position ``config.patches``; the output ``commands`` is
    float32 (M, outputs).
    """
    maps = graph.op("Shape", "positions", end=1)
    x = _embed(graph, config)
    for layer in range(config.depth - 1):
        x = _layer(graph, f"blocks.{layer}", x, config, maps)
    x = _read_out(graph, f"blocks.{config.depth - 1}", x, config, maps)
    graph.op("Identity", graph.head(x, config), name="commands")
    inputs = {
        "patches": (TensorProto.FLOAT, ["maps", "slots", config.patch**2]),
        "positions": (TensorProto.INT64, ["maps", "slots"]),
    }
    return graph.model(inputs, "maps", config.outputs)
