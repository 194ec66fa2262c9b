"""The network on maps of running teams, beside the same network computed on every patch."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from numpy.typing import NDArray
from onnxruntime import InferenceSession

from benchmarks.flops import packed_flops
from benchmarks.matmul import best_rate, products
from benchmarks.peers.dense import DenseTransformer, all_patches, dense_network, dense_session
from benchmarks.report import Aim, Row, number
from benchmarks.scenes import closed_loop_scans
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Side, Spread, compare
from triform.control import shipped_weights
from triform.perception import occupancy_maps
from triform.policy import PackedMaps, PolicyRuntime, pack, vit_network
from triform.policy.export import export_policy
from triform.types import FloatArray, MapArray, MapConfig

#: Inputs that one call of a side goes through.
_INPUTS = 24
_EIGHT_BITS = "large in 8 bits"
_PACKED, _EAGER, _ONNX = "packed", "dense in PyTorch", "dense in ONNX Runtime"


def measure(settings: Settings, watch: Watch) -> Iterator[Row]:
    """One robot and thirteen robots, on one thread."""
    folders = {name: shipped_weights()[name] for name in ("large", "near")}
    dense = {name: dense_network(folder) for name, folder in folders.items()}
    with TemporaryDirectory() as room:
        folders[_EIGHT_BITS] = Path(room) / "int8"
        export_policy(folders["large"], np.concatenate(single_maps(settings)), "int8", folders[_EIGHT_BITS])
        runtimes = {name: PolicyRuntime(folder) for name, folder in folders.items()}
        shapes = {name: vit_network(runtime.spec.network) for name, runtime in runtimes.items()}
        patch = shapes["large"].patch
        for case, inputs in (("one robot", single_maps(settings)), ("13 robots at once", team_maps(settings))):
            packed = [pack(maps, patch) for maps in inputs]
            patches = [all_patches(maps, patch) for maps in inputs]
            sides = [_packed(name, runtime, packed) for name, runtime in runtimes.items()]
            sides += [_eager(name, network, patches) for name, network in dense.items()]
            limits = products(threads=1)
            session = dense_session(dense["large"], patches[0], Path(room) / "dense.onnx", threads=1)
            sides += [_session("large", session, patches), *limits]
            seconds = compare(sides, settings, watch, f"policy, {case}")
            peak = best_rate(seconds, [side.name for side in limits])
            # Per input, as the measured times.
            least = {
                f"{name}, {_PACKED}": sum(packed_flops(shapes[name], each) for each in packed) / len(packed) / peak
                for name in dense
            }
            yield from _rows(case, seconds, least, float(np.concatenate([each.counts for each in packed]).mean()))


def _rows(case: str, seconds: dict[str, FloatArray], least: dict[str, FloatArray], tokens: float) -> Iterator[Row]:
    """Comparisons; ``least`` is the time [s] that the packed products would take at the machine's full rate."""
    for own, peer, aim in (
        (f"large, {_PACKED}", f"large, {_EAGER}", 20),
        (f"large, {_PACKED}", f"large, {_ONNX}", None),
        (f"{_EIGHT_BITS}, {_PACKED}", f"large, {_EAGER}", None),
        (f"near, {_PACKED}", f"large, {_EAGER}", 60 if case == "one robot" else None),
        (f"near, {_PACKED}", f"near, {_EAGER}", None),
    ):
        note = f"{tokens:.1f} of 100 patches are occupied on average. Both sides begin with their patches cut out."
        if own in least:
            note += (
                " If the packed products ran at the machine's full rate and nothing else took time, it would be "
                f"{number(float(np.median(seconds[peer] / least[own])))} x; norms, softmax, GELU, reading the weights "
                "and the fixed cost of some 60 operators take the rest."
            )
        yield Row(
            f"{case}, 1 thread: {own}, against {peer}",
            Spread.of(seconds[peer] / seconds[own], "x"),
            None if aim is None else Aim(">=", aim),
            {name: Spread.of(1e3 * seconds[name], "ms") for name in (own, peer)},
            note,
        )


def single_maps(settings: Settings) -> list[MapArray]:
    """Maps (1, H, W) of single robots of a team of seven, evenly spread over its runs."""
    maps = occupancy_maps(closed_loop_scans(7, settings), MapConfig())
    single = maps.reshape(-1, 1, *maps.shape[2:])
    return [single[k] for k in np.linspace(0, len(single) - 1, _INPUTS).astype(int)]


def team_maps(settings: Settings) -> list[MapArray]:
    """Maps (13, H, W) of a team of thirteen, evenly spread over its runs."""
    maps = occupancy_maps(closed_loop_scans(13, settings), MapConfig())
    return [maps[k] for k in np.linspace(0, len(maps) - 1, _INPUTS // 4).astype(int)]


def _packed(name: str, runtime: PolicyRuntime, inputs: list[PackedMaps]) -> Side:
    return Side(f"{name}, {_PACKED}", lambda: [runtime.commands(each) for each in inputs], len(inputs))


def _eager(name: str, network: DenseTransformer, inputs: list[NDArray[np.float32]]) -> Side:
    tensors = [torch.from_numpy(each) for each in inputs]

    @torch.inference_mode()
    def work() -> None:
        torch.set_num_threads(1)
        for each in tensors:
            network(each)

    return Side(f"{name}, {_EAGER}", work, len(inputs))


def _session(name: str, session: InferenceSession, inputs: list[NDArray[np.float32]]) -> Side:
    return Side(f"{name}, {_ONNX}", lambda: [session.run(None, {"patches": each}) for each in inputs], len(inputs))
