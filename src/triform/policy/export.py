"""From a trained policy to ONNX: the graph, checked against PyTorch before it takes its place."""

from __future__ import annotations

import logging
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from onnxruntime.quantization import QuantType, quantize_dynamic

from triform.files import cannot_write
from triform.policy.checkpoint import PolicySpec, Precision, read_weights, weights_name, write_policy
from triform.policy.config import map_network
from triform.policy.gnn_runtime import GnnRuntime
from triform.policy.kinds import network_inputs, write_graph
from triform.policy.packing import PackedMaps, pack
from triform.policy.radius_graph import RadiusGraph
from triform.policy.runtime import PolicyRuntime
from triform.policy.weights import network_of
from triform.types import FloatArray, MapArray, TriformError

#: Largest difference of a command from PyTorch's [m/s or rad/s]; of 8-bit numbers, the largest mean difference.
TOLERANCE: dict[Precision, float] = {"float32": 1e-4, "int8": 2e-2}


@dataclass(frozen=True)
class Difference:
    """How far an exported policy's commands are from PyTorch's [m/s or rad/s].

    Attributes:
        largest: Largest difference of a number.
        mean: Mean difference.
    """

    largest: float
    mean: float


def export_policy(
    folder: Path, fresh: MapArray | RadiusGraph, precision: Precision = "float32", out: Path | None = None
) -> Difference:
    """Write the graph of the policy in ``folder``.

    With ``int8`` the graph holds weights of 8 bits and rounds the tokens of a call to 8 bits by their common range,
    which is faster and a little less exact.

    Args:
        folder: Holds a policy.
        fresh: On what the graph is compared with PyTorch: occupancy maps (M, H, W), or teams for a graph network.
        precision: Numbers of the linear layers.
        out: Folder for the exported policy, weights included; ``folder`` itself by default.

    Returns:
        The difference found.

    Raises:
        TriformError: If the folder holds no policy, the commands differ, or a file cannot be written; a graph that
            was there stays then.
    """
    spec, weights = read_weights(folder)
    network = network_of(spec, weights)
    given = fresh if isinstance(fresh, RadiusGraph) else _packed(fresh, spec)
    try:
        with tempfile.TemporaryDirectory() as trial, torch.inference_mode():
            graph = write_graph(spec.network, weights, weights_name(spec))
            if precision == "int8":
                graph = _quantised(graph, Path(trial, weights_name(spec)), weights)
            exported = replace(spec, precision=precision)
            write_policy(Path(trial), exported, weights, graph)
            commands = _run(Path(trial), given)
            errors = np.abs(commands - network(network_inputs(given)).numpy())
    except OSError as error:
        raise cannot_write(Path(tempfile.gettempdir()), error) from error
    difference = Difference(float(errors.max(initial=0.0)), float(errors.mean()) if errors.size else 0.0)
    found = difference.mean if precision == "int8" else difference.largest
    if not found <= TOLERANCE[precision]:
        raise TriformError(
            f"the exported graph of {folder} differs from PyTorch by {found:.1e} on {len(commands)} robots; "
            f"{TOLERANCE[precision]:.0e} is allowed, so it is not kept"
        )
    write_policy(out or folder, exported, weights, graph, instead_of=spec if out is None else None)
    return difference


def _packed(maps: MapArray, spec: PolicySpec) -> PackedMaps:
    network = map_network(spec.network)
    return pack(maps, network.patch, network.attention)


def _run(folder: Path, given: PackedMaps | RadiusGraph) -> FloatArray:
    """What the exported policy in ``folder`` answers."""
    if isinstance(given, RadiusGraph):
        return GnnRuntime(folder).commands(given)
    return PolicyRuntime(folder).commands(given)


def _quantised(graph: bytes, path: Path, weights: bytes) -> bytes:
    """The graph with 8-bit linear layers; its weights are written to ``path``, and other files beside it."""
    full, reduced = path.with_name("full.onnx"), path.with_name("reduced.onnx")
    full.write_bytes(graph)
    path.write_bytes(weights)
    # The quantiser advises a preparation that changes nothing here.
    before = logging.root.manager.disable
    logging.disable(max(before, logging.WARNING))
    try:
        # Products of unsigned numbers: with signed weights, processors without VNNI would saturate in 16 bits.
        quantize_dynamic(full, reduced, op_types_to_quantize=["Gemm", "MatMul"], weight_type=QuantType.QUInt8)
    finally:
        logging.disable(before)
    return reduced.read_bytes()
