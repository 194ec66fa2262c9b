"""How many scans and occupancy maps per second the simulator makes: 7 robots, 450 rays, 2 m, one and all threads.

Run: python benchmarks/throughput.py (about 20 s). Prints a Markdown table.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable

import numba
import numpy as np

from triform.perception import occupancy_maps
from triform.simulation import ROBOMASTER_EP, Arena, cast_scans, starts
from triform.types import MapConfig, Scan, ScanConfig

ROBOTS, WORLDS, REPEATS = 7, 2000, 9
SCAN = ScanConfig()


def rate(work: Callable[[], object]) -> tuple[float, float, float]:
    """Median, least and most maps per second over several repeats of ``work``."""
    work()
    rates = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        work()
        rates.append(ROBOTS * WORLDS / (time.perf_counter() - began))
    return float(np.median(rates)), min(rates), max(rates)


def main() -> None:
    """Print the table."""
    poses = starts(ROBOTS, WORLDS, seed=0)
    active = np.ones(poses.shape[:2], dtype=np.bool_)
    arena = Arena.open()
    ranges = cast_scans(poses, active, ROBOMASTER_EP, arena, SCAN)

    def scan() -> object:
        return cast_scans(poses, active, ROBOMASTER_EP, arena, SCAN)

    def perceive() -> object:
        return occupancy_maps(Scan(ranges, SCAN), MapConfig())

    def both() -> object:
        return occupancy_maps(Scan(cast_scans(poses, active, ROBOMASTER_EP, arena, SCAN), SCAN), MapConfig())

    print(f"{platform.machine()}, {numba.config.NUMBA_NUM_THREADS} cores\n")
    print("| work | threads | per second (median) | least | most |\n|---|---|---|---|---|")
    for threads in sorted({1, numba.config.NUMBA_NUM_THREADS}):
        numba.set_num_threads(threads)
        for name, work in (("scan", scan), ("Algorithm 3", perceive), ("scan + Algorithm 3", both)):
            median, least, most = rate(work)
            print(f"| {name} | {threads} | {median:,.0f} | {least:,.0f} | {most:,.0f} |")


if __name__ == "__main__":
    main()
