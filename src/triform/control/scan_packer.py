"""From scans to packed maps at one go: Algorithm 3 and packing without a dense map in between."""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from triform.kernels import kernel
from triform.perception import MapWorkspace, map_rules, map_workspace, occupied_into
from triform.policy import Keep, PackedMaps, append_patches
from triform.types import FloatArray, IntArray, MapConfig, ScanConfig, require

#: Scans that are packed at once; more only take more memory.
SCANS_AT_ONCE = 512


class _Workspace(NamedTuple):
    """What one thread works on and writes.

    Attributes:
        map: Of ``occupied_into``.
        at_rest: Poses of robots that have not moved, zeros, shape (SCANS_AT_ONCE, 3).
        slots: Of ``append_patches``, int32, shape (P,) for the P patches of a map.
        patches: Patches, uint8, shape (SCANS_AT_ONCE * P, patch * patch).
        positions: Their places in their maps, shape (SCANS_AT_ONCE * P,).
        counts: Patches of every scan, shape (SCANS_AT_ONCE,).
    """

    map: MapWorkspace
    at_rest: FloatArray
    slots: NDArray[np.int32]
    patches: NDArray[np.uint8]
    positions: IntArray
    counts: IntArray


def _make_workspace(size: int, patch: int) -> _Workspace:
    per_map = (size // patch) ** 2
    return _Workspace(
        map_workspace(size),
        np.zeros((SCANS_AT_ONCE, 3)),
        np.full(per_map, -1, dtype=np.int32),
        # Pages of these that no patch reaches are never touched.
        np.empty((SCANS_AT_ONCE * per_map, patch**2), dtype=np.uint8),
        np.empty(SCANS_AT_ONCE * per_map, dtype=np.int64),
        np.empty(SCANS_AT_ONCE, dtype=np.int64),
    )


@kernel
def _pack_scans(ranges, odometry, cos, sin, rules, patch, keep_all, workspace):
    """Fill the patches, positions and counts of a ``_Workspace`` from ``ranges`` (M, R); return the number of patches.

    Robots see from where they have moved to since, (M, 3). The other arguments are those of ``occupied_into`` and
    ``append_patches``.
    """
    cells, size = workspace.map.cells, workspace.map.grid.shape[0] - 2
    slots, patches, positions = workspace.slots, workspace.patches, workspace.positions
    token = 0
    for m in range(ranges.shape[0]):
        count = occupied_into(ranges[m], odometry[m], cos, sin, rules, workspace.map)
        after = append_patches(cells, count, size, patch, keep_all, slots, patches, positions, token)
        workspace.counts[m] = after - token
        token = after
    return token


class ScanPacker:
    """Packs the occupancy maps of scans that share one configuration; each thread keeps its workspace."""

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
        self._rules = map_rules(scan, config)
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
            The packed maps; views of this thread's workspace, good until its next call.

        Raises:
            ConfigurationError: If there are more scans, or they have another number of rays.
        """
        require(
            ranges.ndim == 2 and len(ranges) <= SCANS_AT_ONCE and ranges.shape[1] == self.scan.rays,
            f"ranges of shape {ranges.shape} given; up to {SCANS_AT_ONCE} scans of {self.scan.rays} rays are needed",
        )
        workspace = getattr(self._local, "workspace", None)
        if workspace is None:
            workspace = self._local.workspace = _make_workspace(self._map.size, self._patch)
        moved = workspace.at_rest[: len(ranges)] if odometry is None else odometry
        tokens = _pack_scans(ranges, moved, self._cos, self._sin, self._rules, self._patch, self._keep_all, workspace)
        return PackedMaps(workspace.patches[:tokens], workspace.positions[:tokens], workspace.counts[: len(ranges)])
