"""Algorithm 3: from one LiDAR scan to a binary occupancy map of the robots around.

1. Project every return to the cell it lies in. A robot that has moved since its scan knows so from its wheels; returns
   are then drawn where they lie seen from where it is now.
2. Smooth with a 3 x 3 Gaussian and set what is not zero to one. Every weight of the kernel is positive, so this is
   exactly a dilation by one cell in all eight directions, and it is computed as that.
3. Drop 4-connected groups that are too large (walls) or too small (noise).

This is the only implementation; data, training and robots all call it.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from triform.kernels import kernel
from triform.threads import in_parts
from triform.types import FloatArray, IntArray, MapArray, MapConfig, Scan, ScanConfig

# Bits of a cell of the working grid.
_MARKED = 1
_CLOSED = 2
_HIT = 4
#: Scans that keep a thread busy for a few milliseconds.
_SCANS_PER_THREAD = 300


class MapRules(NamedTuple):
    """How the returns of a scan become a map.

    Attributes:
        range_max: Farther returns do not count [m].
        cell: Side of a cell [m].
        min_cells: Smaller groups of cells are dropped.
        max_cells: Larger groups are dropped.
    """

    range_max: float
    cell: float
    min_cells: int
    max_cells: int


class MapWorkspace(NamedTuple):
    """What ``occupied_into`` reads and writes for maps of H x H cells.

    Attributes:
        grid: Marks of all cells and of a closed border, uint8, shape (H + 2, H + 2); left as it was.
        scratch: Lists of cells on that grid, int32, shape (2, H * H).
        cells: Flat indices ``row * H + column`` of the occupied cells, int32, shape (H * H,); filled from the front, in
            no particular order.
    """

    grid: Any
    scratch: Any
    cells: Any


def map_rules(scan: ScanConfig, config: MapConfig) -> MapRules:
    """Return how the returns of a LiDAR become a map, as kernels take it."""
    return MapRules(float(scan.range_max), float(config.cell), config.min_cells, config.max_cells)


@kernel
def map_workspace(size):
    """Make a ``MapWorkspace`` for maps of ``size`` x ``size`` cells."""
    # A closed border spares every look at a neighbour the question whether it is on the map.
    grid = np.full((size + 2, size + 2), _CLOSED, dtype=np.uint8)
    grid[1:-1, 1:-1] = 0
    return MapWorkspace(grid, np.empty((2, size * size), dtype=np.int32), np.empty(size * size, dtype=np.int32))


@kernel
def _dilate_returns(ranges, moved, cos, sin, rules, size, grid, marked):
    """Mark the 3 x 3 cells around every return on the flat ``grid``; list them in ``marked``; return how many."""
    range_max, cell = rules.range_max, rules.cell
    half = size * cell / 2
    stride = size + 2
    count = 0
    turned_cos, turned_sin = np.cos(moved[2]), np.sin(moved[2])
    for k in range(ranges.shape[0]):
        distance = ranges[k]
        if not 0.0 < distance <= range_max:
            continue
        x, y = distance * cos[k] - moved[0], distance * sin[k] - moved[1]
        row = int(np.floor((turned_cos * x + turned_sin * y + half) / cell))
        column = int(np.floor((turned_cos * y - turned_sin * x + half) / cell))
        if row < 0 or row >= size or column < 0 or column >= size:
            continue
        centre = (row + 1) * stride + column + 1
        # Neighbouring rays often end in the same cell.
        if grid[centre] & _HIT:
            continue
        for first in (centre - stride - 1, centre - 1, centre + stride - 1):
            for near in range(first, first + 3):
                if grid[near] == 0:
                    grid[near] = _MARKED
                    marked[count] = near
                    count += 1
        grid[centre] |= _HIT
    return count


@kernel
def _flood(grid, stride, start, queue):
    """Close the 4-connected group around cell ``start``, list it in ``queue`` and return its size."""
    grid[start] |= _CLOSED
    queue[0] = start
    head, tail = 0, 1
    while head < tail:
        here = queue[head]
        head += 1
        for near in (here - stride, here + stride, here - 1, here + 1):
            if grid[near] & (_MARKED | _CLOSED) == _MARKED:
                grid[near] |= _CLOSED
                queue[tail] = near
                tail += 1
    return tail


@kernel
def occupied_into(ranges, moved, cos, sin, rules, workspace):
    """List the occupied cells of one scan's map at the front of ``workspace.cells``.

    Args:
        ranges: Ranges [m], shape (R,); what is not in (0, range_max] is no return.
        moved: Pose of the robot now in its body frame at the moment of the scan [m, m, rad], shape (3,).
        cos: Cosine of every ray's angle, shape (R,).
        sin: Sine of every ray's angle, shape (R,).
        rules: ``MapRules``.
        workspace: ``MapWorkspace``.

    Returns:
        The number of occupied cells.
    """
    grid, scratch, cells = workspace
    size = grid.shape[0] - 2
    stride = size + 2
    flat = grid.reshape(stride * stride)
    marked, queue = scratch[0], scratch[1]
    count = _dilate_returns(ranges, moved, cos, sin, rules, size, flat, marked)
    kept = 0
    for m in range(count):
        if flat[marked[m]] & _CLOSED:
            continue
        members = _flood(flat, stride, marked[m], queue)
        if rules.min_cells <= members <= rules.max_cells:
            for q in range(members):
                # A product with the inverse is exact here and many times faster than a division.
                row = int((queue[q] + 0.5) * (1.0 / stride))
                cells[kept] = queue[q] - 2 * row - size - 1
                kept += 1
    for m in range(count):
        flat[marked[m]] = 0
    return kept


@kernel
def _maps(ranges, moved, cos, sin, rules, out, first, last):
    size = out.shape[1]
    workspace = map_workspace(size)
    cells = workspace.cells
    for m in range(first, last):
        kept = occupied_into(ranges[m], moved[m], cos, sin, rules, workspace)
        for q in range(kept):
            out[m, cells[q] // size, cells[q] % size] = 1


@kernel
def _label(occupancy, labels):
    size = occupancy.shape[0]
    stride = size + 2
    grid = map_workspace(size).grid
    for i in range(size):
        for j in range(size):
            if occupancy[i, j]:
                grid[i + 1, j + 1] = _MARKED
    flat = grid.reshape(stride * stride)
    queue = np.empty(size * size, dtype=np.int32)
    groups = 0
    for i in range(size):
        for j in range(size):
            if occupancy[i, j] and labels[i, j] == 0:
                groups += 1
                for q in range(_flood(flat, stride, (i + 1) * stride + j + 1, queue)):
                    labels[queue[q] // stride - 1, queue[q] % stride - 1] = groups
    return groups


def label_groups(occupancy: MapArray) -> tuple[IntArray, int]:
    """Return the 4-connected groups of occupied cells, as Algorithm 3 finds them.

    Args:
        occupancy: A square map, shape (H, H).

    Returns:
        The number of every cell's group, counted from 1 row by row and 0 where nothing is, shape (H, H); and how many
        groups there are.
    """
    labels = np.zeros(occupancy.shape, dtype=np.int64)
    return labels, _label(np.ascontiguousarray(occupancy), labels)


def occupancy_maps(scan: Scan, config: MapConfig, odometry: FloatArray | None = None) -> MapArray:
    """Binary occupancy maps of scans (Algorithm 3).

    The robot is at the centre of the map; rows grow with x (forward), columns with y (left); cell (i, j) covers
    ``x`` in ``[i * cell - half, (i + 1) * cell - half)`` and ``y`` likewise. Returns outside the
    map are ignored.

    Args:
        scan: Ranges of shape (..., R); what is not in (0, range_max] is no return (REP 117).
        config: Size of the map and limits of the groups that are kept.
        odometry: Poses of the robots in their body frames at the moments of their scans [m, m, rad], shape (..., 3);
            robots have not moved since if omitted.

    Returns:
        Maps, uint8, shape (..., H, W): 1 where a robot-sized group of returns is, 0 elsewhere.
    """
    angles = scan.config.angles
    cos, sin = np.cos(angles), np.sin(angles)
    ranges = np.ascontiguousarray(scan.ranges).reshape(-1, scan.config.rays)
    moved = np.zeros((len(ranges), 3)) if odometry is None else np.ascontiguousarray(odometry).reshape(-1, 3)
    out = np.zeros((ranges.shape[0], config.size, config.size), dtype=np.uint8)
    rules = map_rules(scan.config, config)
    in_parts(partial(_maps, ranges, moved, cos, sin, rules, out), len(ranges), len(ranges), _SCANS_PER_THREAD)
    return out.reshape(*scan.ranges.shape[:-1], config.size, config.size)
