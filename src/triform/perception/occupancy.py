"""Algorithm 3: from one LiDAR scan to a binary occupancy map of the robots around.

1. Project every return to the cell it lies in.
2. Smooth with a 3 x 3 Gaussian and set what is not zero to one. Every weight of the kernel is positive, so this is
   exactly a dilation by one cell in all eight directions, and it is computed as that.
3. Drop 4-connected groups that are too large (walls) or too small (noise).

This is the only implementation; data, training and robots all call it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from triform.threads import in_parts
from triform.types import MapArray, MapConfig, Scan

_MARKED = 1
_VISITED = 2
#: Scans that keep a thread busy for a few milliseconds.
_SCANS_PER_THREAD = 300


@njit(cache=True, nogil=True)
def _dilate_returns(ranges, cos, sin, range_max, cell, grid, stack):  # type: ignore[no-untyped-def]
    """Mark the 3 x 3 cells around every return on ``grid``; list them in ``stack``; return how many."""
    size = grid.shape[0]
    half = size * cell / 2
    count = 0
    for k in range(ranges.shape[0]):
        distance = ranges[k]
        if not 0.0 < distance <= range_max:
            continue
        row = int(np.floor((distance * cos[k] + half) / cell))
        column = int(np.floor((distance * sin[k] + half) / cell))
        if row < 0 or row >= size or column < 0 or column >= size:
            continue
        for i in range(max(row - 1, 0), min(row + 2, size)):
            for j in range(max(column - 1, 0), min(column + 2, size)):
                if grid[i, j] == 0:
                    grid[i, j] = _MARKED
                    stack[count] = i * size + j
                    count += 1
    return count


@njit(cache=True, nogil=True)
def _flood(grid, start, queue):  # type: ignore[no-untyped-def]
    """Visit the 4-connected group around cell ``start``, list it in ``queue`` and return its size."""
    size = grid.shape[0]
    grid[start // size, start % size] = _VISITED
    queue[0] = start
    head, tail = 0, 1
    while head < tail:
        i, j = queue[head] // size, queue[head] % size
        head += 1
        if i > 0 and grid[i - 1, j] == _MARKED:
            grid[i - 1, j] = _VISITED
            queue[tail] = (i - 1) * size + j
            tail += 1
        if i < size - 1 and grid[i + 1, j] == _MARKED:
            grid[i + 1, j] = _VISITED
            queue[tail] = (i + 1) * size + j
            tail += 1
        if j > 0 and grid[i, j - 1] == _MARKED:
            grid[i, j - 1] = _VISITED
            queue[tail] = i * size + j - 1
            tail += 1
        if j < size - 1 and grid[i, j + 1] == _MARKED:
            grid[i, j + 1] = _VISITED
            queue[tail] = i * size + j + 1
            tail += 1
    return tail


@njit(cache=True, nogil=True)
def occupied_into(ranges, cos, sin, range_max, cell, min_cells, max_cells, grid, scratch, cells):  # type: ignore[no-untyped-def]
    """List the occupied cells of one scan's map.

    Args:
        ranges: Ranges [m], shape (R,); what is not in (0, range_max] is no return.
        cos: Cosine of every ray's angle, shape (R,).
        sin: Sine of every ray's angle, shape (R,).
        range_max: Longest range [m].
        cell: Side of a cell [m].
        min_cells: Smaller groups are dropped.
        max_cells: Larger groups are dropped.
        grid: Working grid, uint8, shape (H, W); must be all zero and is left all zero.
        scratch: Working room, int32, shape (2, H * W).
        cells: Flat indices ``row * W + column`` of the occupied cells, int32, shape (H * W,); filled from the
            front, in no particular order.

    Returns:
        The number of occupied cells.
    """
    size = grid.shape[0]
    marked, queue = scratch[0], scratch[1]
    count = _dilate_returns(ranges, cos, sin, range_max, cell, grid, marked)
    kept = 0
    for m in range(count):
        start = marked[m]
        if grid[start // size, start % size] != _MARKED:
            continue
        members = _flood(grid, start, queue)
        if min_cells <= members <= max_cells:
            for q in range(members):
                cells[kept] = queue[q]
                kept += 1
    for m in range(count):
        grid[marked[m] // size, marked[m] % size] = 0
    return kept


@njit(cache=True, nogil=True)
def _maps(ranges, cos, sin, range_max, cell, min_cells, max_cells, first, last, out):  # type: ignore[no-untyped-def]
    size = out.shape[1]
    grid = np.zeros((size, size), dtype=np.uint8)
    scratch = np.empty((2, size * size), dtype=np.int32)
    cells = np.empty(size * size, dtype=np.int32)
    for m in range(first, last):
        kept = occupied_into(ranges[m], cos, sin, range_max, cell, min_cells, max_cells, grid, scratch, cells)
        for q in range(kept):
            out[m, cells[q] // size, cells[q] % size] = 1


def occupancy_maps(scan: Scan, config: MapConfig) -> MapArray:
    """Binary occupancy maps of scans (Algorithm 3).

    The robot is at the centre of the map; rows grow with x (forward), columns with y (left); cell (i, j) covers
    ``x`` in ``[i * cell - half, (i + 1) * cell - half)`` and ``y`` likewise. Returns outside the
    map are ignored.

    Args:
        scan: Ranges of shape (..., R); what is not in (0, range_max] is no return (REP 117).
        config: Size of the map and limits of the groups that are kept.

    Returns:
        Maps, uint8, shape (..., H, W): 1 where a robot-sized group of returns is, 0 elsewhere.
    """
    angles = scan.config.angles
    cos, sin = np.cos(angles), np.sin(angles)
    ranges = np.ascontiguousarray(scan.ranges).reshape(-1, scan.config.rays)
    out = np.zeros((ranges.shape[0], config.size, config.size), dtype=np.uint8)
    limits = (scan.config.range_max, config.cell, config.min_cells, config.max_cells)
    in_parts(
        lambda first, last: _maps(ranges, cos, sin, *limits, first, last, out),
        len(ranges),
        len(ranges),
        _SCANS_PER_THREAD,
    )
    return out.reshape(*scan.ranges.shape[:-1], config.size, config.size)
