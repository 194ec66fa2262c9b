"""How long one robot takes from scan to command, and the same networks dense in PyTorch; one thread.

Run: python benchmarks/latency.py (needs the dev extra; about 20 s). Prints a Markdown table.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numba
import numpy as np
import torch

from triform.control import LearnedPolicy, shipped_weights
from triform.perception import occupancy_maps
from triform.policy import PolicyRuntime, pack
from triform.policy.vit import VisionTransformer, token_batch
from triform.simulation import World, get_profile, starts
from triform.types import MapConfig, Scan, View

REPEATS = 500


def milliseconds(work: Callable[[int], object], repeats: int) -> tuple[float, float]:
    """Median and 99th percentile of the time of ``work(k)`` for k = 0, 1, ... [ms]."""
    taken = []
    for k in range(-10, repeats):
        began = time.perf_counter()
        work(k)
        if k >= 0:
            taken.append(1e3 * (time.perf_counter() - began))
    return float(np.median(taken)), float(np.quantile(taken, 0.99))


def row(name: str, parameters: int, median: float, tail: float) -> None:
    """Print one line of the table."""
    print(f"| {name} | {parameters:,} | {median:.2f} | {tail:.2f} |")


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    scans = World(starts(7, REPEATS // 7 + 1, seed=0), get_profile("ideal")).observe().scans
    ranges = scans.ranges.reshape(-1, 1, 1, scans.config.rays)
    maps = occupancy_maps(Scan(ranges[:, 0, 0], scans.config), MapConfig())
    print("| scan to command | parameters | median [ms] | 99 % [ms] |\n|---|---|---|---|")
    for name, folder in shipped_weights().items():
        runtime = PolicyRuntime(folder, threads=1)
        policy = LearnedPolicy(runtime)
        views = [View(Scan(each, scans.config), np.ones((1, 1), dtype=bool), 0.0) for each in ranges]
        config = runtime.spec.network
        parameters = sum(p.numel() for p in VisionTransformer(config).parameters())
        row(f"`{name}`", parameters, *milliseconds(lambda k, v=views, p=policy: p.command(v[k]), REPEATS))
        dense = VisionTransformer(replace(config, attention="all")).eval()
        batches = [token_batch(pack(each[None], config.patch, "all")) for each in maps[:100]]
        with torch.inference_mode():
            timing = milliseconds(lambda k, b=batches, d=dense: d(b[k]), 100)
        row(f"the network of `{name}` alone, all patches, PyTorch", parameters, *timing)


if __name__ == "__main__":
    main()
