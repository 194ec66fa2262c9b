"""Scans and occupancy maps per second, and what bounds their kernels."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.bandwidth import triads
from benchmarks.report import Aim, Row, number
from benchmarks.scenes import start_poses
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Side, Spread, compare
from triform.control.scan_packer import SCANS_AT_ONCE, ScanPacker
from triform.perception import occupancy_maps
from triform.policy import NetworkConfig
from triform.simulation import ROBOMASTER_EP, Arena, cast_scans
from triform.threads import in_parts, limit_threads
from triform.types import FloatArray, MapConfig, Scan, ScanConfig

ROBOTS = 7
SCAN, MAP = ScanConfig(), MapConfig()
#: Work that uses more of the memory bandwidth than this share is bound by it.
_MEMORY_BOUND = 0.6
#: Bytes written or read for one scan and one map.
SCAN_BYTES = 8 * SCAN.rays
MAP_BYTES = MAP.size**2


def measure(settings: Settings, watch: Watch) -> Iterator[Row]:
    """Scan, Algorithm 3 and both, on one and on all threads."""
    worlds = 20 if settings.quick else 2000
    poses = start_poses(ROBOTS, worlds)
    active = np.ones(poses.shape[:2], dtype=np.bool_)
    count = worlds * ROBOTS
    meetings = _meetings(poses) / count

    def scan() -> FloatArray:
        return cast_scans(poses, active, ROBOMASTER_EP, Arena.open(), SCAN)

    pack = _packing()
    ranges = scan()
    bandwidth = triads(settings)
    for threads in settings.thread_counts:
        sides = [
            Side("scan", scan, count),
            Side("Algorithm 3", lambda: occupancy_maps(Scan(ranges, SCAN), MAP), count),
            Side("scan + Algorithm 3", lambda: occupancy_maps(Scan(scan(), SCAN), MAP), count),
            Side("scan + Algorithm 3, packed", lambda: pack(scan()), count),
            Side("triad", bandwidth[threads].work, bandwidth[threads].amount),
        ]
        with limit_threads(threads):
            seconds = compare(sides, settings, watch, f"scan and Algorithm 3, {threads} threads")
        rates = {name: Spread.of(1 / each, "/s") for name, each in seconds.items()}
        where = f"{ROBOTS} robots, {SCAN.rays} rays, {threads} thread{'s' * (threads > 1)}"
        yield Row(
            f"scans/s, {where}",
            rates["scan"],
            note=f"{number(meetings * rates['scan'].median)} meetings of a ray and a box a second ({meetings:.0f} a "
            f"scan), one division each. {_traffic(seconds, 'scan', SCAN_BYTES)}",
        )
        yield Row(
            f"maps/s of given scans (Algorithm 3), {where}",
            rates["Algorithm 3"],
            note="Groups are flooded cell by cell, with a branch each. "
            + _traffic(seconds, "Algorithm 3", SCAN_BYTES + MAP_BYTES),
        )
        aim = Aim(">=", 300_000) if threads == settings.cores else None
        yield Row(
            f"maps/s, scan + Algorithm 3, {where}",
            rates["scan + Algorithm 3"],
            aim,
            note="All cells of all maps are written. "
            + _traffic(seconds, "scan + Algorithm 3", 2 * SCAN_BYTES + MAP_BYTES),
        )
        yield Row(
            f"maps/s, scan + Algorithm 3, occupied patches alone, {where}",
            rates["scan + Algorithm 3, packed"],
            aim,
            note="What the policy reads: no map is written, only its patches that hold something. "
            + _traffic(seconds, "scan + Algorithm 3, packed", 2 * SCAN_BYTES),
        )


def _packing() -> Callable[[FloatArray], None]:
    """Algorithm 3 and packing at one go, as a policy does it, on as many threads as may be used."""
    packer = ScanPacker(SCAN, MAP, NetworkConfig().patch)

    def pack(ranges: FloatArray) -> None:
        scans = ranges.reshape(-1, SCAN.rays)

        def part(first: int, last: int) -> None:
            for begin in range(first, last, SCANS_AT_ONCE):
                packer.pack(scans[begin : min(begin + SCANS_AT_ONCE, last)])

        in_parts(part, len(scans), len(scans), SCANS_AT_ONCE)

    return pack


def _meetings(poses: FloatArray) -> float:
    """How many times a ray meets a box within its range, whether or not something nearer hides it."""
    met = 0.0
    for i in range(ROBOTS):
        for j in range(ROBOTS):
            if i != j:
                pair = np.ascontiguousarray(poses[:, [i, j]])
                active = np.ones(pair.shape[:2], dtype=np.bool_)
                ranges = cast_scans(pair, active, ROBOMASTER_EP, Arena.open(), SCAN)[:, 0]
                met += float(np.isfinite(ranges).sum())
    return met


def _traffic(seconds: dict[str, FloatArray], name: str, size: int) -> str:
    """Bytes moved and their share of the bandwidth measured in the same turns, in words."""
    rate = size / seconds[name]
    share = float(np.median(rate * seconds["triad"]))
    bound = "memory" if share > _MEMORY_BOUND else "computing"
    return (
        f"At least {size / 1000:.1f} kB each, {np.median(rate) / 1e9:.1f} GB/s: {100 * share:.0f} % of the memory "
        f"bandwidth, so {bound} bounds it."
    )
