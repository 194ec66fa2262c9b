"""The ONNX graph of the graph network, written node by node; the weights stay in the safetensors file.

It reads the edges of any number of teams at once; the function is that of ``gnn.GraphNetwork``.
"""

from __future__ import annotations

import numpy as np
from onnx import TensorProto, helper

from triform.policy.config import GnnConfig
from triform.policy.graph import Graph
from triform.policy.radius_graph import EDGE_FEATURES, SUM_SCALE


def _round(graph: Graph, name: str, robots: str, edges: str, shape: str, config: GnnConfig) -> tuple[str, str]:
    """One round of messages: robots (M, D) and edges (E, D) to the same; ``shape`` names (M, D)."""
    dim, mlp = config.dim, config.mlp
    known = graph.norm(f"{name}.norm_robot", robots, dim)
    hidden = graph.linear(f"{name}.from_edge", graph.norm(f"{name}.norm_edge", edges, dim), dim, mlp)
    for end in ("receiver", "sender"):
        told = graph.op("Gemm", known, graph.weight(f"{name}.from_{end}.weight", mlp, dim), transB=1)
        hidden = graph.op("Add", hidden, graph.op("Gather", told, f"{end}s"))
    edges = graph.op("Add", edges, graph.linear(f"{name}.to_edge", graph.op("Gelu", hidden), mlp, dim))
    nothing = graph.op("ConstantOfShape", shape)
    indices = graph.op("Unsqueeze", "receivers", graph.constant("[1]", [1]))
    heard = graph.op("ScatterND", nothing, indices, edges, reduction="add")
    scaled = graph.op("Mul", heard, graph.constant("sum_scale", np.float32(SUM_SCALE)))
    joined = graph.op("Concat", known, scaled, axis=1)
    hidden = graph.op("Gelu", graph.linear(f"{name}.expand", joined, 2 * dim, mlp))
    return str(graph.op("Add", robots, graph.linear(f"{name}.contract", hidden, mlp, dim))), str(edges)


def build_gnn_graph(config: GnnConfig, weights: bytes, file_name: str) -> bytes:
    """Write the network as an ONNX model whose weights stand in a safetensors file beside it.

    Inputs are those of ``RadiusGraph``: ``features``, float32 (E, EDGE_FEATURES), ``receivers`` and ``senders``, int64
    (E,), and ``robots``, int64 (1,); the output ``commands`` is float32 (M, outputs).

    Args:
        config: Shape of the network.
        weights: Content of the safetensors file.
        file_name: Name of that file, which must lie in the model's folder.

    Returns:
        The serialised model.

    Raises:
        TriformError: If the weights are not those of such a network.
    """
    graph = Graph(weights, file_name)
    dim, mlp = config.dim, config.mlp
    shape = graph.op("Concat", "robots", graph.constant("dim", [dim]), axis=0)
    robots = graph.op("Expand", graph.weight("start", dim), shape)
    hidden = graph.op("Gelu", graph.linear("embed.0", "features", EDGE_FEATURES, mlp))
    edges = graph.linear("embed.2", hidden, mlp, dim)
    for number in range(config.rounds):
        robots, edges = _round(graph, f"rounds.{number}", robots, edges, shape, config)
    hidden = graph.linear("head.0", graph.norm("norm", robots, dim), dim, mlp)
    answers = graph.linear("head.2", graph.op("Gelu", hidden), mlp, config.outputs)
    graph.op("Identity", answers, name="commands")
    return graph.model(
        [
            helper.make_tensor_value_info("features", TensorProto.FLOAT, ["edges", EDGE_FEATURES]),
            helper.make_tensor_value_info("receivers", TensorProto.INT64, ["edges"]),
            helper.make_tensor_value_info("senders", TensorProto.INT64, ["edges"]),
            helper.make_tensor_value_info("robots", TensorProto.INT64, [1]),
        ],
        [helper.make_tensor_value_info("commands", TensorProto.FLOAT, ["robots", config.outputs])],
    )
