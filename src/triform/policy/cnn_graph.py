"""The ONNX graph of the convolutional network, written node by node; the weights stay in the safetensors file.

It reads whole maps, one byte for each cell; the function is that of ``cnn.ConvolutionalNetwork``.
"""

from __future__ import annotations

from onnx import TensorProto

from triform.policy.config import CnnConfig
from triform.policy.graph import Graph


def _convolution(graph: Graph, name: str, x: str, shape: tuple[int, int, int], step: int = 1, margin: int = 0) -> str:
    """Convolution with square kernels of ``shape`` (outputs, inputs, side), and ReLU, on grids (M, inputs, H, H)."""
    outputs, inputs, side = shape
    weight = graph.weight(f"{name}.weight", outputs, inputs, side, side)
    bias = graph.weight(f"{name}.bias", outputs)
    return str(graph.op("Relu", graph.op("Conv", x, weight, bias, strides=[step, step], pads=[margin] * 4)))


def build_cnn_graph(graph: Graph, config: CnnConfig) -> bytes:
    """Finish ``graph`` as the network of shape ``config``; see ``kinds.write_graph``.

    The input ``maps`` is uint8 (M, H, H), the output ``commands`` float32 (M, outputs).
    """
    step, channels, size = config.patch // 2, config.channels, config.map_size
    x = graph.reshape(graph.op("Cast", "maps", to=TensorProto.FLOAT), -1, 1, size, size)
    x = _convolution(graph, "look", x, (config.stem, 1, step + 2), step=step, margin=1)
    x = _convolution(graph, "gather", x, (channels, config.stem, 3), step=2, margin=1)
    for layer in range(config.depth):
        x = graph.op("Add", x, _convolution(graph, f"mix.{layer}", x, (channels, channels, 3), margin=1))
    x = _convolution(graph, "squeeze", x, (config.squeeze, channels, 1))
    width = config.squeeze * config.patches
    # A row of zeros is added for the time, because a single row is summed in another order than several.
    rows = graph.op("Pad", graph.reshape(x, -1, width), graph.constant("one_row", [0, 0, 1, 0]))
    answers = graph.head(graph.linear("read", rows, width, config.dim), config)
    graph.op("Slice", answers, graph.constant("[0]", [0]), graph.constant("[-1]", [-1]), name="commands")
    return graph.model({"maps": (TensorProto.UINT8, ["maps", size, size])}, "maps", config.outputs)
