"""Demonstrations in memory: what a team looked like and what its teacher commanded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triform.kernels import kernel
from triform.types import FloatArray, IntArray, MapArray


@kernel
def _gather(cells, offsets, sources, gathered_offsets, gathered):
    for m in range(sources.shape[0]):
        begin = offsets[sources[m]]
        target = gathered_offsets[m]
        for k in range(gathered_offsets[m + 1] - target):
            gathered[target + k] = cells[begin + k]


@dataclass(frozen=True)
class Records:
    """Some records; one record is one moment of one team of N robots, so it holds N maps.

    Maps are kept as the list of their occupied cells, about a hundredth of a dense map. With B records there
    are ``M = B * N`` maps, ordered record by record; map ``m`` is that of robot ``m % N`` in record ``m // N``.

    Attributes:
        run: Run every record belongs to, shape (B,).
        step: Place of every record in its run, shape (B,).
        poses: Poses in the world frame [m, m, rad], shape (B, N, 3).
        commands: The teacher's body twists [m/s, m/s, rad/s], float32, shape (M, 3).
        cells: Flat indices ``row * W + column`` of the occupied cells of all maps, ascending within a map.
        offsets: Map ``m`` owns ``cells[offsets[m]:offsets[m + 1]]``, shape (M + 1,), starting at 0.
        map_size: Cells along each side of a map, H = W.
    """

    run: NDArray[np.int32]
    step: NDArray[np.int32]
    poses: FloatArray
    commands: NDArray[np.float32]
    cells: NDArray[np.integer]
    offsets: IntArray
    map_size: int

    def __len__(self) -> int:
        """Number of records B."""
        return len(self.run)

    @property
    def robots(self) -> int:
        """Robots in every record, N."""
        return int(self.poses.shape[1])

    def maps(self) -> MapArray:
        """The dense maps, uint8, shape (M, H, W)."""
        count, area = len(self.offsets) - 1, self.map_size**2
        dense = np.zeros(count * area, dtype=np.uint8)
        first_cell = np.repeat(np.arange(count, dtype=np.int64) * area, np.diff(self.offsets))
        dense[first_cell + self.cells] = 1
        return dense.reshape(count, self.map_size, self.map_size)

    def part(self, begin: int, end: int) -> Records:
        """Records ``begin`` to ``end`` (exclusive), as views."""
        first, last = begin * self.robots, end * self.robots
        offsets = self.offsets[first : last + 1]
        return Records(
            run=self.run[begin:end],
            step=self.step[begin:end],
            poses=self.poses[begin:end],
            commands=self.commands[first:last],
            cells=self.cells[offsets[0] : offsets[-1]],
            offsets=offsets - offsets[0],
            map_size=self.map_size,
        )

    def take(self, order: IntArray) -> Records:
        """The records at the indices ``order``, in that order."""
        sources = (order[:, None] * self.robots + np.arange(self.robots)).reshape(-1)
        offsets = np.zeros(len(sources) + 1, dtype=np.int64)
        np.cumsum(np.diff(self.offsets)[sources], out=offsets[1:])
        cells = np.empty(offsets[-1], dtype=self.cells.dtype)
        _gather(self.cells, self.offsets, sources, offsets, cells)
        return Records(
            run=self.run[order],
            step=self.step[order],
            poses=self.poses[order],
            commands=self.commands[sources],
            cells=cells,
            offsets=offsets,
            map_size=self.map_size,
        )


def concatenate(parts: Sequence[Records]) -> Records:
    """Join records of one map size; at least one part is needed."""
    if len(parts) == 1:
        return parts[0]
    counts = np.concatenate([np.diff(part.offsets) for part in parts])
    return Records(
        run=np.concatenate([part.run for part in parts]),
        step=np.concatenate([part.step for part in parts]),
        poses=np.concatenate([part.poses for part in parts]),
        commands=np.concatenate([part.commands for part in parts]),
        cells=np.concatenate([part.cells for part in parts]),
        offsets=np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(counts, dtype=np.int64)]),
        map_size=parts[0].map_size,
    )
