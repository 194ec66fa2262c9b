"""Running a policy with ONNX Runtime, without PyTorch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime

from triform.policy.checkpoint import PolicySpec, check_graph, read_spec, read_weights
from triform.policy.packing import PackedMaps
from triform.types import ConfigurationError, FloatArray, TriformError

# Rows of one call: large enough to use the processor, small enough to stay in its cache.
_ROWS = 256


class PolicyRuntime:
    """A policy that turns packed occupancy maps into body twists."""

    def __init__(self, folder: Path, threads: int | None = None) -> None:
        """Load the policy in ``folder``.

        Args:
            folder: Holds ``model.onnx``, ``model.safetensors`` and ``model.json``.
            threads: Threads of the network; ONNX Runtime's own choice if ``None``.

        Raises:
            TriformError: If the folder holds no exported policy, or it cannot be loaded.
        """
        if threads is not None and threads < 1:
            raise ConfigurationError(f"threads is {threads}; it must be at least 1")
        self.folder = folder
        self.spec: PolicySpec = read_spec(folder)
        read_weights(folder, self.spec)
        path = check_graph(folder, self.spec)
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        if threads is not None:
            options.intra_op_num_threads = threads
            options.inter_op_num_threads = 1
        try:
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"], enable_fallback=0
            )
        except Exception as error:
            raise TriformError(f"cannot load the policy {path}: {str(error).splitlines()[0]}") from error

        cells = self._session.get_inputs()[0].shape[-1]
        outputs = self._session.get_outputs()[0].shape[-1]
        network = self.spec.network
        if (cells, outputs) != (network.patch**2, network.outputs):
            raise TriformError(
                f"{path} reads patches of {cells} cells and gives {outputs} numbers; its description says "
                f"{network.patch**2} and {network.outputs}"
            )

    def commands(self, packed: PackedMaps) -> FloatArray:
        """Body twists (M, 3) [m/s, m/s, rad/s] of M maps.

        Maps with equally many patches share a call, so nothing is computed on padding.
        """
        out = np.zeros((len(packed.counts), self.spec.network.outputs))
        first = np.cumsum(packed.counts) - packed.counts
        for count in np.unique(packed.counts):
            rows = np.flatnonzero(packed.counts == count)
            for begin in range(0, len(rows), _ROWS):
                part = rows[begin : begin + _ROWS]
                tokens = first[part, None] + np.arange(count)
                (out[part],) = self._session.run(
                    None,
                    {"patches": packed.patches[tokens].astype(np.float32), "positions": packed.positions[tokens]},
                )
        return out
