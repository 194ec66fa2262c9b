"""From poses to the occupied cells of every robot's map, without dense maps in between."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from triform.kernels import kernel
from triform.perception import map_rules, map_workspace, occupied_into
from triform.simulation import Arena, Footprint
from triform.simulation.lidar import cast_world, scan_rays
from triform.simulation.ray_kernels import Scene
from triform.types import FloatArray, IntArray, MapConfig, ScanConfig

#: A return marks a block of 3 x 3 cells.
_CELLS_PER_RAY = 9


@kernel
def _sense_into(poses, scene, scan, size, rules, cells, offsets):
    """Fill ``cells`` and ``offsets``, as in ``Records``, from poses (B, N, 3)."""
    cos, sin = scan.cos, scan.sin
    robots, rays = poses.shape[1], cos.shape[0]
    axes = np.empty((robots, 2))
    active = np.ones(robots, dtype=np.bool_)
    ranges = np.empty((robots, rays))
    workspace = map_workspace(size)
    found = workspace.cells
    at_rest = np.zeros(3)
    filled = 0
    offsets[0] = 0
    for b in range(poses.shape[0]):
        cast_world(poses[b], active, scene, scan, axes, ranges)
        for i in range(robots):
            count = occupied_into(ranges[i], at_rest, cos, sin, rules, workspace)
            found[:count].sort()
            for k in range(count):
                cells[filled + k] = found[k]
            filled += count
            offsets[b * robots + i + 1] = filled


def cell_dtype(map_config: MapConfig) -> np.dtype[np.integer]:
    """The smallest signed integer that holds every flat cell index."""
    return np.dtype(np.int16 if map_config.size**2 - 1 <= np.iinfo(np.int16).max else np.int32)


def sense(
    poses: FloatArray, footprint: Footprint, scan: ScanConfig, map_config: MapConfig
) -> tuple[NDArray[np.integer], IntArray]:
    """Cast every robot's exact scan in the open plane and make its map, on one thread.

    The maps are those of ``occupancy_maps`` on the scans of ``cast_scans``, to the bit.

    Args:
        poses: Poses in the world frame [m, m, rad], shape (B, N, 3).
        footprint: Outline of every robot.
        scan: Rays and limits of range.
        map_config: Size of the maps and limits of the groups that are kept.

    Returns:
        Occupied cells and offsets as in ``Records``.
    """
    count = poses.shape[0] * poses.shape[1]
    most = min(map_config.size**2, _CELLS_PER_RAY * scan.rays)
    cells = np.empty(count * most, dtype=cell_dtype(map_config))
    offsets = np.empty(count + 1, dtype=np.int64)
    arena = Arena.open()
    _sense_into(
        np.ascontiguousarray(poses),
        Scene(footprint.body, arena.walls, arena.pillars),
        scan_rays(scan),
        map_config.size,
        map_rules(scan, map_config),
        cells,
        offsets,
    )
    return cells[: offsets[-1]].copy(), offsets
