"""From a trained policy to ONNX: the graph, checked against PyTorch before it takes its place."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from triform.files import sha256, write_atomically
from triform.policy.checkpoint import ONNX_FILE, SPEC_FILE, WEIGHTS_FILE, read_weights
from triform.policy.graph import build_graph
from triform.policy.packing import pack
from triform.policy.runtime import PolicyRuntime
from triform.policy.vit import token_batch
from triform.policy.weights import load_policy
from triform.types import MapArray, TriformError

#: Largest difference of a command from PyTorch's [m/s or rad/s].
TOLERANCE = 1e-4


def export_policy(folder: Path, maps: MapArray) -> float:
    """Write ``model.onnx`` next to the weights of the policy in ``folder``.

    Args:
        folder: Holds ``model.safetensors`` and ``model.json``.
        maps: Occupancy maps (M, H, W) on which the graph's commands must be PyTorch's to 1e-4.

    Returns:
        The largest difference found.

    Raises:
        TriformError: If the folder holds no policy, the commands differ, or a file cannot be written; a graph that
            was there stays then.
    """
    network, spec = load_policy(folder)
    weights = read_weights(folder, spec)
    graph = build_graph(spec.network, weights, WEIGHTS_FILE)
    exported = replace(spec, onnx_sha256=sha256(graph))
    files = {WEIGHTS_FILE: weights, ONNX_FILE: graph, SPEC_FILE: exported.to_json().encode()}
    packed = pack(maps, spec.network.patch, spec.network.attention)
    with tempfile.TemporaryDirectory() as trial, torch.inference_mode():
        for name, content in files.items():
            write_atomically(Path(trial) / name, content)
        commands = PolicyRuntime(Path(trial)).commands(packed)
        difference = float(np.abs(commands - network(token_batch(packed)).numpy()).max(initial=0.0))
    if not difference <= TOLERANCE:
        raise TriformError(
            f"the exported graph of {folder} differs from PyTorch by {difference:.1e} on {len(maps)} maps; "
            f"{TOLERANCE:.0e} is allowed, so it is not kept"
        )
    for name in (ONNX_FILE, SPEC_FILE):
        write_atomically(folder / name, files[name])
    return difference
