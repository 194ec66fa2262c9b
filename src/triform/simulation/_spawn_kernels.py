"""Compiled checks of random placements."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def spaced(positions: Any, spacing: float) -> bool:
    """Whether no two of ``positions``, shape (N, 2) [m], are closer than ``spacing`` [m]."""
    for i in range(positions.shape[0]):
        for j in range(i):
            dx = positions[i, 0] - positions[j, 0]
            dy = positions[i, 1] - positions[j, 1]
            if dx * dx + dy * dy < spacing * spacing:
                return False
    return True


@njit(cache=True, nogil=True)
def linked(positions: Any, reach: float) -> bool:
    """Whether the graph of pairs within ``reach`` [m] connects all ``positions``, shape (N, 2) [m]."""
    count = positions.shape[0]
    found = np.zeros(count, dtype=np.bool_)
    queue = np.empty(count, dtype=np.int64)
    queue[0] = 0
    found[0] = True
    length = 1
    head = 0
    while head < length:
        i = queue[head]
        head += 1
        for j in range(count):
            dx = positions[i, 0] - positions[j, 0]
            dy = positions[i, 1] - positions[j, 1]
            if not found[j] and dx * dx + dy * dy <= reach * reach:
                found[j] = True
                queue[length] = j
                length += 1
    return bool(length == count)


@njit(cache=True, nogil=True)
def first_valid(candidates: Any, spacing: float, reach: float) -> int:
    """Index of the first valid placement among ``candidates``, shape (K, N, 2) [m]; -1 if none is."""
    for k in range(candidates.shape[0]):
        if spaced(candidates[k], spacing) and linked(candidates[k], reach):
            return k
    return -1


@njit(cache=True, nogil=True)
def insert_in_turn(candidates: Any, spacing: float, positions: Any) -> int:
    """Fill ``positions``, shape (N, 2), from ``candidates``, skipping those too close to one already in.

    Returns:
        How many were filled.
    """
    filled = 0
    for k in range(candidates.shape[0]):
        if filled == positions.shape[0]:
            break
        free = True
        for i in range(filled):
            dx = positions[i, 0] - candidates[k, 0]
            dy = positions[i, 1] - candidates[k, 1]
            if dx * dx + dy * dy < spacing * spacing:
                free = False
                break
        if free:
            positions[filled, 0] = candidates[k, 0]
            positions[filled, 1] = candidates[k, 1]
            filled += 1
    return filled
