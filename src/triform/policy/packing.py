"""Packing: cut occupancy maps into patches and keep those that hold something, without PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from triform.types import ConfigurationError, IntArray, MapArray


@dataclass(frozen=True)
class PackedMaps:
    """Patches of M maps, one behind the other, in row-major order within each map.

    Attributes:
        patches: Cells of every patch, row-major, uint8, shape (K, patch * patch).
        positions: Index of every patch in its map's grid of patches, row-major, shape (K,).
        counts: Patches of every map, shape (M,), summing to K.
    """

    patches: NDArray[np.uint8]
    positions: IntArray
    counts: IntArray


@njit(cache=True, nogil=True)
def _mark_patches(maps, patch, occupied):  # type: ignore[no-untyped-def]
    for m in range(maps.shape[0]):
        for i in range(maps.shape[1]):
            for j in range(maps.shape[2]):
                if maps[m, i, j]:
                    occupied[m, i // patch, j // patch] = True


@njit(cache=True, nogil=True)
def _copy_patches(maps, patch, kept, patches, positions, counts):  # type: ignore[no-untyped-def]
    token = 0
    columns = kept.shape[2]
    for m in range(maps.shape[0]):
        first = token
        for a in range(kept.shape[1]):
            for b in range(columns):
                if kept[m, a, b]:
                    positions[token] = a * columns + b
                    for i in range(patch):
                        for j in range(patch):
                            patches[token, i * patch + j] = maps[m, a * patch + i, b * patch + j]
                    token += 1
        counts[m] = token - first


def pack(maps: MapArray, patch: int, keep: Literal["occupied", "all"] = "occupied") -> PackedMaps:
    """Cut maps into square patches and keep the occupied ones, or all.

    Args:
        maps: Occupancy maps, shape (M, H, W).
        patch: Cells along each side of a patch.
        keep: Which patches to keep.

    Raises:
        ConfigurationError: If the maps are not a batch of maps that divides into patches.
    """
    if maps.ndim != 3 or maps.shape[1] % patch or maps.shape[2] % patch:
        raise ConfigurationError(
            f"maps of shape {maps.shape} do not divide into patches of {patch} x {patch} cells; (M, H, W) is needed"
        )
    grid = (maps.shape[0], maps.shape[1] // patch, maps.shape[2] // patch)
    kept = np.full(grid, keep == "all")
    if keep == "occupied":
        _mark_patches(maps, patch, kept)
    tokens = int(kept.sum())
    patches = np.empty((tokens, patch * patch), dtype=np.uint8)
    positions = np.empty(tokens, dtype=np.int64)
    counts = np.empty(maps.shape[0], dtype=np.int64)
    _copy_patches(maps, patch, kept, patches, positions, counts)
    return PackedMaps(patches, positions, counts)
