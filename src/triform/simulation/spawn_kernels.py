"""Compiled checks of random placements."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from triform.geometry.cells import pairs_within, squared_distance
from triform.kernels import kernel


@kernel
def is_connected(positions: Any, reach: float) -> bool:
    """Whether the graph of pairs within ``reach`` [m] connects all ``positions``, shape (N, 2) [m]."""
    return bool(linked_groups(positions, reach).max() == 0)


@kernel
def linked_groups(positions: Any, reach: float) -> Any:
    """Smallest robot that each is connected with over pairs within ``reach`` [m]; positions of shape (N, 2) [m]."""
    count = positions.shape[0]
    pairs = pairs_within(positions, np.ones(count, dtype=np.bool_), reach * reach)
    groups = np.arange(count)
    for pair in range(pairs.shape[0]):
        i, j = pairs[pair]
        while groups[i] != i:
            groups[i] = groups[groups[i]]
            i = groups[i]
        while groups[j] != j:
            groups[j] = groups[groups[j]]
            j = groups[j]
        groups[max(i, j)] = min(i, j)
    for i in range(count):
        groups[i] = groups[groups[i]]
    return groups


@kernel
def _are_spaced(positions: Any, spacing: float) -> bool:
    """Whether no two of ``positions``, shape (N, 2) [m], are closer than ``spacing`` [m]."""
    for i in range(positions.shape[0]):
        for j in range(i):
            if squared_distance(positions, i, j) < spacing * spacing:
                return False
    return True


@kernel
def first_valid(candidates: Any, spacing: float, reach: float) -> int:
    """Index of the first valid placement among ``candidates``, shape (K, N, 2) [m]; -1 if none is."""
    for k in range(candidates.shape[0]):
        if _are_spaced(candidates[k], spacing) and is_connected(candidates[k], reach):
            return k
    return -1


@kernel
def _column(value: float, side: float, columns: int) -> int:
    """Column, or row, of a coordinate in a square around the origin."""
    return min(max(int((value / side + 0.5) * columns), 0), columns - 1)


@kernel
def _list_robot(robot: int, positions: Any, side: float, heads: Any, following: Any) -> None:
    """Put a robot at the head of the list of its grid cell."""
    row = _column(positions[robot, 1], side, heads.shape[0])
    column = _column(positions[robot, 0], side, heads.shape[0])
    following[robot] = heads[row, column]
    heads[row, column] = robot


@kernel
def _any_within(place: Any, distance: float, positions: Any, side: float, heads: Any, following: Any) -> bool:
    """Whether a robot in the grid is nearer to ``place`` than ``distance`` [m]."""
    columns = heads.shape[0]
    # Slightly more, so that no rounding of a column matters.
    around = distance * (1 + 1e-9)
    for row in range(_column(place[1] - around, side, columns), _column(place[1] + around, side, columns) + 1):
        for column in range(_column(place[0] - around, side, columns), _column(place[0] + around, side, columns) + 1):
            robot = heads[row, column]
            while robot >= 0:
                dx = positions[robot, 0] - place[0]
                dy = positions[robot, 1] - place[1]
                if dx * dx + dy * dy < distance * distance:
                    return True
                robot = following[robot]
    return False


@kernel
def insert_in_turn(candidates: Any, spacing: float, reach: float, side: float, missing: Any, positions: Any) -> int:
    """Give places to missing robots one after the other, from ``candidates`` in their order.

    A candidate is taken if nobody is nearer than ``spacing`` and, unless ``reach`` is infinite, somebody within it.

    Args:
        candidates: Places in a square around the origin, shape (K, 2) [m].
        spacing: Least distance to everybody [m].
        reach: Greatest distance from somebody [m]; infinite for none.
        side: Side of the square [m].
        missing: Robots that have no place, shape (M,).
        positions: Places of all, shape (N, 2) [m]; those of the missing robots are written.

    Returns:
        How many robots were given a place.
    """
    count = positions.shape[0]
    columns = max(1, min(int(side / spacing), math.ceil(2 * math.sqrt(count))))
    heads = np.full((columns, columns), -1, dtype=np.int64)
    following = np.empty(count, dtype=np.int64)
    present = np.ones(count, dtype=np.bool_)
    present[missing] = False
    for robot in range(count):
        if present[robot]:
            _list_robot(robot, positions, side, heads, following)
    filled = 0
    for k in range(candidates.shape[0]):
        if filled == missing.shape[0]:
            break
        if _any_within(candidates[k], spacing, positions, side, heads, following):
            continue
        if reach < math.inf and not _any_within(candidates[k], reach, positions, side, heads, following):
            continue
        positions[missing[filled]] = candidates[k]
        _list_robot(missing[filled], positions, side, heads, following)
        filled += 1
    return filled
