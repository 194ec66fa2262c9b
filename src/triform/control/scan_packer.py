"""From scans to packed maps at one go: Algorithm 3 and packing without a dense map in between."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from triform.kernels import kernel
from triform.perception import map_workspace, occupied_into
from triform.policy import Keep, PackedMaps, append_patches
from triform.types import FloatArray, MapConfig, ScanConfig, require

#: Scans that are packed at once; more only take more room.
SCANS_AT_ONCE = 512


@kernel
def _pack_scans(
    ranges,
    odometry,
    cos,
    sin,
    range_max,
    cell,
    min_cells,
    max_cells,
    patch,
    keep_all,
    grid,
    scratch,
    cells,
    slots,
    patches,
    positions,
    counts,
):
    """Fill ``patches``, ``positions`` and ``counts`` from ``ranges`` (M, R); return the number of patches.

    Robots see from where they have moved to since, (M, 3). The other arguments are those of ``occupied_into`` and
    ``append_patches``.
    """
    token = 0
    for m in range(ranges.shape[0]):
        count = occupied_into(
            ranges[m], odometry[m], cos, sin, range_max, cell, min_cells, max_cells, grid, scratch, cells
        )
        after = append_patches(cells, count, grid.shape[0] - 2, patch, keep_all, slots, patches, positions, token)
        counts[m] = after - token
        token = after
    return token


class _Workspace:
    """Working room of one thread."""

    def __init__(self, size: int, patch: int) -> None:
        per_map = (size // patch) ** 2
        self.grid, self.scratch, self.cells = map_workspace(size)
        self.at_rest = np.zeros((SCANS_AT_ONCE, 3))
        self.slots = np.full(per_map, -1, dtype=np.int32)
        # Pages of these that no patch reaches are never touched.
        self.patches = np.empty((SCANS_AT_ONCE * per_map, patch**2), dtype=np.uint8)
        self.positions = np.empty(SCANS_AT_ONCE * per_map, dtype=np.int64)
        self.counts = np.empty(SCANS_AT_ONCE, dtype=np.int64)


class ScanPacker:
    """Packs the occupancy maps of scans that share one configuration; each thread keeps its working room."""

    def __init__(self, scan: ScanConfig, config: MapConfig, patch: int, keep: Keep = "occupied") -> None:
        """Prepare for scans.

        Args:
            scan: The LiDAR.
            config: The occupancy map.
            patch: Cells along each side of a patch; divides the map.
            keep: Which patches to keep.

        Raises:
            ConfigurationError: If the map does not divide into patches.
        """
        require(
            patch >= 1 and config.size % patch == 0,
            f"a map of {config.size} cells does not divide into patches of {patch}",
        )
        self.scan = scan
        self._map = config
        self._patch = patch
        self._keep_all = keep == "all"
        self._cos, self._sin = np.cos(scan.angles), np.sin(scan.angles)
        self._local = threading.local()

    def pack(self, ranges: NDArray[np.floating], odometry: FloatArray | None = None) -> PackedMaps:
        """Pack the maps of up to ``SCANS_AT_ONCE`` scans.

        Args:
            ranges: Ranges [m], shape (M, R); what is not in (0, range_max] is no return.
            odometry: Poses of the robots now in their body frames at the moments of their scans [m, m, rad], shape
                (M, 3); where they were if ``None``.

        Returns:
            The packed maps; views of this thread's room, good until its next call.

        Raises:
            ConfigurationError: If there are more scans, or they have another number of rays.
        """
        require(
            ranges.ndim == 2 and len(ranges) <= SCANS_AT_ONCE and ranges.shape[1] == self.scan.rays,
            f"ranges of shape {ranges.shape} given; up to {SCANS_AT_ONCE} scans of {self.scan.rays} rays are needed",
        )
        room = getattr(self._local, "room", None)
        if room is None:
            room = self._local.room = _Workspace(self._map.size, self._patch)
        tokens = _pack_scans(
            ranges,
            room.at_rest[: len(ranges)] if odometry is None else odometry,
            self._cos,
            self._sin,
            self.scan.range_max,
            self._map.cell,
            self._map.min_cells,
            self._map.max_cells,
            self._patch,
            self._keep_all,
            room.grid,
            room.scratch,
            room.cells,
            room.slots,
            room.patches,
            room.positions,
            room.counts,
        )
        return PackedMaps(room.patches[:tokens], room.positions[:tokens], room.counts[: len(ranges)])
