"""The ONNX graph of the graph network, written node by node; the weights stay in the safetensors file.

It reads the edges of any number of teams at once; the function is that of ``gnn.GraphNetwork``.
"""

from __future__ import annotations

import numpy as np
from onnx import TensorProto

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


def build_gnn_graph(graph: Graph, config: GnnConfig) -> bytes:
    """Finish ``graph`` as the network of shape ``config``; see ``kinds.write_graph``.

    Inputs are those of ``RadiusGraph``: ``features``, float32 (E, EDGE_FEATURES), ``receivers`` and ``senders``, int64
    (E,), and ``robots``, int64 (1,); the output ``commands`` is float32 (M, outputs).
    """
    dim, mlp = config.dim, config.mlp
    shape = graph.op("Concat", "robots", graph.constant("dim", [dim]), axis=0)
    robots = graph.op("Expand", graph.weight("start", dim), shape)
    hidden = graph.op("Gelu", graph.linear("embed.0", "features", EDGE_FEATURES, mlp))
    edges = graph.linear("embed.2", hidden, mlp, dim)
    for number in range(config.rounds):
        robots, edges = _round(graph, f"rounds.{number}", robots, edges, shape, config)
    graph.op("Identity", graph.head(robots, config), name="commands")
    inputs = {
        "features": (TensorProto.FLOAT, ["edges", EDGE_FEATURES]),
        "receivers": (TensorProto.INT64, ["edges"]),
        "senders": (TensorProto.INT64, ["edges"]),
        "robots": (TensorProto.INT64, [1]),
    }
    return graph.model(inputs, "robots", config.outputs)
