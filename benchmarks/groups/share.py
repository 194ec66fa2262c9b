"""How much of the machine's matrix-multiply rate the packed policy reaches, on one thread."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.flops import dense_flops, packed_flops, plain_flops
from benchmarks.groups.policy import single_maps, team_maps
from benchmarks.matmul import best_rate, products
from benchmarks.report import Aim, Row
from benchmarks.scenes import closed_loop_scans
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Side, Spread, compare
from triform.control import shipped_weights
from triform.perception import occupancy_maps
from triform.policy import PackedMaps, PolicyRuntime, pack, vit_network
from triform.types import MapConfig


def measure(settings: Settings, watch: Watch) -> Iterator[Row]:
    """Both shipped policies, for one robot, a team and many teams."""
    limits = products(threads=1)
    names = [side.name for side in limits]
    for weights, aim in (("large", Aim(">=", 50.0)), ("near", None)):
        runtime = PolicyRuntime(shipped_weights()[weights], threads=1)
        network = vit_network(runtime.spec.network)
        for case, inputs in _inputs(settings, network.patch).items():
            sides = [*limits, _policy(runtime, inputs)]
            seconds = compare(sides, settings, watch, f"share of the peak, {weights}, {case}")
            peak = best_rate(seconds, names)
            maps = sum(len(each.counts) for each in inputs)
            done = sum(packed_flops(network, each) for each in inputs)
            plain = sum(plain_flops(network, each) for each in inputs)
            rate = done / seconds["policy"]
            yield Row(
                f"share of the matrix-multiply rate, `{weights}`, {case}, 1 thread",
                Spread.of(100 * rate / peak, "%"),
                aim,
                {
                    "policy": Spread.of(1e-9 * rate, "GFLOP/s"),
                    "limit": Spread.of(1e-9 * peak, "GFLOP/s"),
                    "time of a map": Spread.of(1e6 * seconds["policy"] / maps, "µs"),
                },
                f"{1e-6 * done / maps:.2f} MFLOP of products a map. All layers for all occupied patches would "
                f"take {1e-6 * plain / maps:.2f} (at which this speed would be "
                f"{np.median(100 * plain / done * rate / peak):.0f} %), the dense network "
                f"{1e-6 * dense_flops(network):.0f}. Norms, softmax, GELU and calls take time and count nothing.",
            )


def _policy(runtime: PolicyRuntime, inputs: list[PackedMaps]) -> Side:
    return Side("policy", lambda: [runtime.commands(each) for each in inputs])


def _inputs(settings: Settings, patch: int) -> dict[str, list[PackedMaps]]:
    """Packed maps of running teams, by how many go into one call."""
    bulk = occupancy_maps(closed_loop_scans(13, settings), MapConfig())
    return {
        "one robot": [pack(maps, patch) for maps in single_maps(settings)],
        "13 robots": [pack(maps, patch) for maps in team_maps(settings)],
        f"{bulk.shape[0] * bulk.shape[1]} robots": [pack(bulk.reshape(-1, *bulk.shape[2:]), patch)],
    }
