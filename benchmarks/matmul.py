"""Large matrix products in single precision, one library each."""

from __future__ import annotations

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from threadpoolctl import threadpool_limits

from benchmarks.timing import Side
from triform.types import FloatArray

#: Rows and columns of all three matrices: large enough that nothing but arithmetic counts.
SIZE = 1024


def flops() -> float:
    """Floating-point operations of one product."""
    return 2.0 * SIZE**3


def products(threads: int) -> list[Side]:
    """One product in NumPy, PyTorch and ONNX Runtime, each on ``threads`` threads."""
    rng = np.random.default_rng(0)
    left = rng.standard_normal((SIZE, SIZE)).astype(np.float32)
    right = rng.standard_normal((SIZE, SIZE)).astype(np.float32)
    out = np.empty_like(left)

    def in_numpy() -> None:
        with threadpool_limits(threads, "blas"):
            np.matmul(left, right, out=out)

    torch_left, torch_right = torch.from_numpy(left), torch.from_numpy(right)
    torch_out = torch.empty_like(torch_left)

    def in_torch() -> None:
        torch.set_num_threads(threads)
        torch.mm(torch_left, torch_right, out=torch_out)

    session = _session(right, threads)
    return [
        Side("NumPy", in_numpy, flops()),
        Side("PyTorch", in_torch, flops()),
        Side("ONNX Runtime", lambda: session.run(None, {"left": left}), flops()),
    ]


def best_rate(seconds: dict[str, FloatArray], names: list[str]) -> FloatArray:
    """Operations per second of the library that is fastest in the median, for every turn."""
    best = min(names, key=lambda name: float(np.median(seconds[name])))
    return 1 / seconds[best]


def _session(right: NDArray[np.float32], threads: int) -> onnxruntime.InferenceSession:
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["left", "right"], ["out"])],
        "product",
        [helper.make_tensor_value_info("left", TensorProto.FLOAT, [SIZE, SIZE])],
        [helper.make_tensor_value_info("out", TensorProto.FLOAT, [SIZE, SIZE])],
        [numpy_helper.from_array(right, "right")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
