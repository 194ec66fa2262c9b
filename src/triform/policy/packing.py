"""Packing: cut occupancy maps into patches and keep those that hold something, without PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from triform.kernels import kernel
from triform.types import ConfigurationError, IntArray, MapArray

Keep = Literal["occupied", "all"]


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


@kernel
def append_patches(cells, count, size, patch, keep_all, slots, patches, positions, token):
    """Append the patches of one map, given by its occupied cells, behind ``token`` patches.

    Args:
        cells: Flat indices ``row * size + column`` of the occupied cells; the first ``count`` count.
        count: Number of occupied cells.
        size: Cells along each side of the map.
        patch: Cells along each side of a patch.
        keep_all: Whether to keep empty patches too.
        slots: Workspace, int32, shape (P,) for the P patches of a map; must be all -1 and is left all -1.
        patches: Patches, shape (K, patch * patch), with room for P more.
        positions: Their positions, shape (K,).
        token: Patches before.

    Returns:
        Patches afterwards.
    """
    columns = size // patch
    # Products with inverses are exact here and many times faster than divisions.
    per_size, per_patch = 1.0 / size, 1.0 / patch
    for c in range(count):
        row = int((cells[c] + 0.5) * per_size)
        column = cells[c] - row * size
        slots[int((row + 0.5) * per_patch) * columns + int((column + 0.5) * per_patch)] = 0
    for p in range(slots.shape[0]):
        if keep_all or slots[p] == 0:
            slots[p] = token
            positions[token] = p
            for c in range(patches.shape[1]):
                patches[token, c] = 0
            token += 1
    for c in range(count):
        row = int((cells[c] + 0.5) * per_size)
        column = cells[c] - row * size
        above, left = int((row + 0.5) * per_patch), int((column + 0.5) * per_patch)
        patches[slots[above * columns + left], (row - above * patch) * patch + column - left * patch] = 1
    slots[:] = -1
    return token


@kernel
def _pack(maps, patch, keep_all, slots, patches, positions, counts):
    size = maps.shape[1]
    cells = np.empty(size * size, dtype=np.int32)
    token = 0
    for m in range(maps.shape[0]):
        count = 0
        for i in range(size):
            for j in range(size):
                if maps[m, i, j]:
                    cells[count] = i * size + j
                    count += 1
        after = append_patches(cells, count, size, patch, keep_all, slots, patches, positions, token)
        counts[m] = after - token
        token = after
    return token


def pack(maps: MapArray, patch: int, keep: Keep = "occupied") -> PackedMaps:
    """Cut maps into square patches and keep the occupied ones, or all.

    Args:
        maps: Occupancy maps, shape (M, H, H).
        patch: Cells along each side of a patch.
        keep: Which patches to keep.

    Raises:
        ConfigurationError: If the maps are not a batch of square maps that divide into patches.
    """
    if maps.ndim != 3 or maps.shape[1] != maps.shape[2] or maps.shape[1] % patch:
        raise ConfigurationError(
            f"maps of shape {maps.shape} do not divide into patches of {patch} x {patch} cells; (M, H, H) is needed"
        )
    per_map = (maps.shape[1] // patch) ** 2
    # Pages of these that no patch reaches are never touched.
    patches = np.empty((len(maps) * per_map, patch**2), dtype=np.uint8)
    positions = np.empty(len(maps) * per_map, dtype=np.int64)
    counts = np.empty(len(maps), dtype=np.int64)
    slots = np.full(per_map, -1, dtype=np.int32)
    tokens = _pack(maps, patch, keep == "all", slots, patches, positions, counts)
    return PackedMaps(patches[:tokens].copy(), positions[:tokens].copy(), counts)
