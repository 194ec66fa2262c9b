"""Running a policy that reads occupancy maps with ONNX Runtime, without PyTorch."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from triform.kernels import kernel
from triform.policy.checkpoint import PLAIN_WEIGHTS, PolicySpec, read_exported, weights_name
from triform.policy.config import CnnConfig, NetworkConfig, map_network
from triform.policy.packing import PackedMaps
from triform.types import FloatArray, MapArray, TriformError, require

#: Tokens of one call: enough to use the processor, few enough to stay in its cache.
_TOKENS_AT_ONCE = 1024
#: Whole maps of one call, likewise.
_MAPS_AT_ONCE = 16


@kernel
def _sort_by_count(counts, begins, order, first):
    """Sort maps by their number of patches, keeping their order where it is the same.

    Args:
        counts: Patches of every map, shape (M,), at most P.
        begins: To fill: where maps with c patches begin in ``order``, shape (P + 2,).
        order: To fill: maps in growing order of their patches, shape (M,).
        first: To fill: first patch of every map, shape (M,).
    """
    begins[:] = 0
    token = 0
    for m in range(counts.shape[0]):
        begins[counts[m] + 1] += 1
        first[m] = token
        token += counts[m]
    for c in range(1, begins.shape[0]):
        begins[c] += begins[c - 1]
    for m in range(counts.shape[0]):
        order[begins[counts[m]]] = m
        begins[counts[m]] += 1
    for c in range(begins.shape[0] - 1, 0, -1):
        begins[c] = begins[c - 1]
    begins[0] = 0


@kernel
def _fill_rows(patches, positions, first, maps, tokens, places):
    """Lay the patches of ``maps`` side by side, each map's behind an empty patch for its class token.

    Args:
        patches: Patches of all maps, shape (K, patch * patch).
        positions: Their positions, shape (K,).
        first: First patch of every map.
        maps: The maps to lay out, shape (m,), with equally many patches.
        tokens: To fill, float32, shape (m, L, patch * patch).
        places: To fill, shape (m, L); holds the position of the class token in slot 0.
    """
    for k in range(maps.shape[0]):
        begin = first[maps[k]]
        for c in range(tokens.shape[2]):
            tokens[k, 0, c] = 0.0
        for slot in range(1, tokens.shape[1]):
            places[k, slot] = positions[begin + slot - 1]
            for c in range(tokens.shape[2]):
                tokens[k, slot, c] = patches[begin + slot - 1, c]


@kernel
def _fits(patches, positions, counts, cells, per_map):
    """Whether packed maps have patches of ``cells`` cells, at most ``per_map`` of them each."""
    if patches.shape[1] != cells or patches.shape[0] != positions.shape[0]:
        return False
    total = 0
    for m in range(counts.shape[0]):
        if counts[m] < 0 or counts[m] > per_map:
            return False
        total += counts[m]
    for k in range(positions.shape[0]):
        if positions[k] < 0 or positions[k] >= per_map:
            return False
    return total == positions.shape[0]


@kernel
def _fill_maps(patches, positions, counts, token, patch, maps):
    """Lay out whole maps; returns the token after theirs.

    Args:
        patches: Patches of all maps, shape (K, patch * patch).
        positions: Their positions, shape (K,).
        counts: Patches of every map that is to be laid out, shape (m,).
        token: First patch of the first of them.
        patch: Cells along each side of a patch.
        maps: To fill, uint8, shape (m, H, H).
    """
    maps[:] = 0
    columns = maps.shape[1] // patch
    for m in range(counts.shape[0]):
        for _ in range(counts[m]):
            row, column = positions[token] // columns * patch, positions[token] % columns * patch
            for c in range(patches.shape[1]):
                maps[m, row + c // patch, column + c % patch] = patches[token, c]
            token += 1
    return token


class _Workspace(threading.local):
    """Workspace, one for each thread; it grows with the largest batch."""

    def __init__(self, patches: int, cells: int) -> None:
        slots = max(_TOKENS_AT_ONCE, patches + 1)
        self.tokens = np.empty(slots * cells, dtype=np.float32)
        self.places = np.empty(slots, dtype=np.int64)
        self.begins = np.empty(patches + 2, dtype=np.int64)
        self.order = np.empty(0, dtype=np.int64)
        self.first = np.empty(0, dtype=np.int64)

    def fit(self, maps: int) -> None:
        """Make the order long enough for so many maps."""
        if maps > len(self.order):
            self.order = np.empty(maps, dtype=np.int64)
            self.first = np.empty(maps, dtype=np.int64)


class StoredPolicy:
    """An exported policy, its files read once: it can be copied, and pickled for machines that do not have the files.

    Attributes:
        folder: Folder that the policy was read from; where it was unpickled, its name alone.
        threads: Threads of one call.
        spec: Description of the policy.
    """

    def __init__(self, folder: Path, threads: int) -> None:
        """Read the exported policy in ``folder``, checked against its description.

        Raises:
            TriformError: If the folder holds no exported policy.
        """
        require(threads >= 1, f"threads is {threads}; it must be at least 1")
        self.folder = folder
        self.threads = threads
        self.spec: PolicySpec
        self.spec, self._weights, self._graph = read_exported(folder)

    def _load(self, outputs: int, name: str, width: int) -> None:
        """Load the graph, whose input ``name`` has ``width`` numbers and whose commands have ``outputs``.

        Raises:
            TriformError: If it cannot be loaded, or is of another shape.
        """
        self._open_session()
        inputs = {each.name: each.shape for each in self._session.get_inputs()}
        found = inputs.get(name, [None])[-1], self._session.get_outputs()[0].shape[-1]
        if found != (width, outputs):
            raise TriformError(
                f"the graph in {self.folder} reads {name} of width {found[0]} and gives {found[1]} numbers; its "
                f"description says {width} and {outputs}"
            )

    def _open_session(self) -> None:
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        options.intra_op_num_threads = self.threads
        options.inter_op_num_threads = 1
        # The graph refers to the weights by the name that they were written with. From memory it gets the very bytes
        # whose checksums were compared.
        names = [weights_name(self.spec), PLAIN_WEIGHTS]
        options.add_external_initializers_from_files_in_memory(names, 2 * [self._weights], 2 * [len(self._weights)])
        try:
            self._session = onnxruntime.InferenceSession(
                self._graph, options, providers=["CPUExecutionProvider"], enable_fallback=0
            )
        except Exception as error:
            raise TriformError(f"cannot load the policy {self.folder}: {str(error).splitlines()[0]}") from error

    def __getstate__(self) -> dict[str, Any]:
        """Return what travels: the contents of the files, and of the folder its name."""
        contents = {"spec": self.spec, "weights": self._weights, "graph": self._graph}
        return {"name": self.folder.name, "threads": self.threads, **contents}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.folder, self.threads = Path(state["name"]), state["threads"]
        self.spec, self._weights, self._graph = state["spec"], state["weights"], state["graph"]
        self._open_session()


class PolicyRuntime(StoredPolicy):
    """A policy that turns packed occupancy maps into body twists; may be called from several threads at once."""

    def __init__(self, folder: Path, threads: int = 1) -> None:
        """Load the policy in ``folder``.

        Args:
            folder: Holds an exported policy.
            threads: Threads of one call. More than one helps a large network on large batches only; batches are
                better split over calls from several threads.

        Raises:
            TriformError: If the folder holds no exported policy, it cannot be loaded, or it reads no maps.
        """
        super().__init__(folder, threads)
        network = map_network(self.spec.network)
        name, cells = ("maps", network.map_size) if isinstance(network, CnnConfig) else ("patches", network.patch**2)
        self._load(network.outputs, name, cells)

    def _open_session(self) -> None:
        super()._open_session()
        self._network = network = map_network(self.spec.network)
        self._workspace = _Workspace(network.patches, network.patch**2)

    def commands(self, packed: PackedMaps) -> FloatArray:
        """Body twists (M, 3) [m/s, m/s, rad/s] of M maps.

        Maps with equally many patches share a call, so nothing is computed on padding. What a map gets is the same to
        the bit whatever other maps are in the batch.

        Raises:
            ConfigurationError: If the maps are not packed for this network.
        """
        network, maps = self._network, len(packed.counts)
        require(
            _fits(packed.patches, packed.positions, packed.counts, network.patch**2, network.patches),
            f"the maps are not packed for the network in {self.folder}: it reads up to {network.patches} patches of "
            f"{network.patch} x {network.patch} cells per map",
        )
        out = np.empty((maps, network.outputs))
        if isinstance(network, CnnConfig):
            self._run_whole(packed, network, out)
        else:
            self._run_packed(packed, network, out)
        return out

    def _run_whole(self, packed: PackedMaps, network: CnnConfig, out: FloatArray) -> None:
        """Fill ``out`` (M, outputs) with what a network that reads whole maps answers."""
        token, at_once = 0, 1 if self.spec.precision == "int8" else _MAPS_AT_ONCE
        maps: MapArray = np.empty((at_once, network.map_size, network.map_size), dtype=np.uint8)
        for begin in range(0, len(out), at_once):
            counts = packed.counts[begin : begin + at_once]
            some = maps[: len(counts)]
            token = _fill_maps(packed.patches, packed.positions, counts, token, network.patch, some)
            (out[begin : begin + at_once],) = self._session.run(["commands"], {"maps": some})

    def _run_packed(self, packed: PackedMaps, network: NetworkConfig, out: FloatArray) -> None:
        """Fill ``out`` (M, outputs) with what the Vision Transformer answers."""
        workspace = self._workspace
        workspace.fit(len(out))
        _sort_by_count(packed.counts, workspace.begins, workspace.order, workspace.first)
        for count in np.flatnonzero(np.diff(workspace.begins)):
            slots = int(count) + 1
            # Graphs of 8 bits round the tokens of a call by their common range.
            at_once = 1 if self.spec.precision == "int8" else max(1, _TOKENS_AT_ONCE // slots)
            for begin in range(workspace.begins[count], workspace.begins[count + 1], at_once):
                some = workspace.order[begin : min(begin + at_once, workspace.begins[count + 1])]
                tokens = workspace.tokens[: len(some) * slots * network.patch**2].reshape(len(some), slots, -1)
                places = workspace.places[: len(some) * slots].reshape(len(some), slots)
                places[:, 0] = network.patches
                _fill_rows(packed.patches, packed.positions, workspace.first, some, tokens, places)
                (out[some],) = self._session.run(["commands"], {"patches": tokens, "positions": places})
