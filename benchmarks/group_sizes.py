"""How large groups of cells are in occupancy maps: what the limits of Algorithm 3 are chosen by.

Run: python benchmarks/group_sizes.py (needs the dev extra; about 10 s). Prints a Markdown table.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from triform.perception import occupancy_maps
from triform.simulation import ROBOMASTER_EP, Arena, cast_scans, sample_starts
from triform.types import FloatArray, MapConfig, Scan, ScanConfig

SCAN = ScanConfig()
UNLIMITED = MapConfig(min_cells=0, max_cells=10_000)
LIMITS = MapConfig()
SAMPLES = 2000


def sizes(ranges: FloatArray) -> FloatArray:
    """Sizes [cells] of all groups in the maps of scans (..., R)."""
    maps = occupancy_maps(Scan(ranges, SCAN), UNLIMITED).reshape(-1, UNLIMITED.size, UNLIMITED.size)
    return np.concatenate([np.bincount(ndimage.label(each)[0].ravel())[1:] for each in maps]).astype(float)


def scan_of(others: FloatArray, arena: Arena | None = None) -> FloatArray:
    """Scans (B, R) of a robot at the origin that looks at robots with poses (B, K, 3)."""
    poses = np.concatenate([np.zeros((len(others), 1, 3)), others], axis=1)
    active = np.ones(poses.shape[:2], dtype=bool)
    return cast_scans(poses, active, ROBOMASTER_EP, arena or Arena.open(), SCAN)[:, 0]


def robots_at(rng: np.random.Generator, distance: float, spacing: float, count: int) -> FloatArray:
    """Robots side by side at a distance, the first in a random direction; poses (SAMPLES, count, 3)."""
    direction = rng.uniform(-np.pi, np.pi, SAMPLES)[:, None] + spacing / distance * np.arange(count)
    heading = rng.uniform(-np.pi, np.pi, (SAMPLES, count))
    return np.stack([distance * np.cos(direction), distance * np.sin(direction), heading], axis=-1)


def row(name: str, groups: FloatArray) -> str:
    """One line of the table."""
    quantiles = np.percentile(groups, [0, 1, 50, 99, 100])
    lost = np.mean((groups < LIMITS.min_cells) | (groups > LIMITS.max_cells))
    return f"| {name} | " + " | ".join(f"{q:.0f}" for q in quantiles) + f" | {100 * lost:.2f} % |"


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    print("| what | least | 1 % | median | 99 % | most | dropped |\n|---|---|---|---|---|---|---|")
    for distance in (0.4, 0.6, 1.0, 1.5, 1.8, 2.0):
        print(row(f"one robot at {distance} m", sizes(scan_of(robots_at(rng, distance, 0, 1)))))
    for count in (2, 3):
        print(row(f"{count} robots 0.42 m apart at 1 m", sizes(scan_of(robots_at(rng, 1.0, 0.42, count)))))
    for robots in (7, 13):
        poses = sample_starts(robots, 300, seed=0)
        ranges = cast_scans(poses, np.ones(poses.shape[:2], dtype=bool), ROBOMASTER_EP, Arena.open(), SCAN)
        print(row(f"starts of {robots} robots, occlusions included", sizes(ranges)))
    for distance in (0.3, 1.0, 1.5, 1.7, 1.8, 1.9):
        walls = []
        for angle in rng.uniform(-np.pi, np.pi, 200):
            normal, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
            ends = distance * normal + np.outer([-5, 5], along)
            arena = Arena(walls=np.array([ends.ravel()]))
            walls.append(scan_of(np.empty((1, 0, 3)), arena))
        print(row(f"a long wall at {distance} m", sizes(np.concatenate(walls))))
    speck = np.full((SAMPLES, SCAN.rays), np.inf)
    ray = rng.integers(SCAN.rays - 1, size=SAMPLES)
    speck[np.arange(SAMPLES), ray] = rng.uniform(0.1, 1.9, SAMPLES)
    print(row("one stray return", sizes(speck)))
    speck[np.arange(SAMPLES), ray + 1] = speck[np.arange(SAMPLES), ray]
    print(row("two neighbouring stray returns", sizes(speck)))


if __name__ == "__main__":
    main()
