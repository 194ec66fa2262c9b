"""States that teams have visited: where everybody stood, in units of the prescribed distance."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from triform.files import write_atomically
from triform.types import FloatArray, IntArray, TriformError, require


@dataclass(frozen=True)
class StateBuffer:
    """Positions of the robots of E states, one state behind the other.

    Attributes:
        positions: Positions in the world frame [d*], shape (K, 2).
        offsets: Where every state begins, and the end of the last one, shape (E + 1,).
    """

    positions: FloatArray
    offsets: IntArray

    def __post_init__(self) -> None:
        sizes = np.diff(self.offsets)
        require(
            self.positions.ndim == 2 and self.positions.shape[1] == 2 and bool(np.isfinite(self.positions).all()),
            f"positions of shape {self.positions.shape} given; finite ones of shape (K, 2) are needed",
        )
        require(
            self.offsets.ndim == 1 and len(self.offsets) >= 1 and self.offsets[0] == 0
            and self.offsets[-1] == len(self.positions) and bool((sizes >= 1).all()),
            "offsets of visited states must grow from 0 to the number of positions",
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @classmethod
    def none(cls) -> StateBuffer:
        """No state at all."""
        return cls(np.empty((0, 2)), np.zeros(1, dtype=np.int64))

    @classmethod
    def of_teams(cls, positions: FloatArray) -> StateBuffer:
        """States of teams of one size, shape (E, N, 2) [d*]."""
        states, robots = positions.shape[:2]
        return cls(positions.reshape(-1, 2).astype(np.float64), robots * np.arange(states + 1, dtype=np.int64))

    def save(self, path: Path) -> None:
        """Write the states into a file that is complete or absent.

        Raises:
            TriformError: If it cannot be written.
        """
        data = io.BytesIO()
        np.savez(data, positions=self.positions.astype(np.float32), offsets=self.offsets)
        write_atomically(path, data.getvalue())

    @classmethod
    def load(cls, path: Path) -> StateBuffer:
        """Read what ``save`` wrote.

        Raises:
            TriformError: If there is no such file, or it holds something else.
        """
        try:
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as data:
                return cls(data["positions"].astype(np.float64), data["offsets"].astype(np.int64))
        except (OSError, ValueError, KeyError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile) as error:
            raise TriformError(f"{path} holds no visited states: {error}") from error


def joined(parts: Sequence[StateBuffer]) -> StateBuffer:
    """All states of several collections."""
    if not parts:
        return StateBuffer.none()
    begins = np.cumsum([0, *(len(part.positions) for part in parts)])
    offsets = [part.offsets[:-1] + begin for part, begin in zip(parts, begins, strict=False)]
    return StateBuffer(
        np.concatenate([part.positions for part in parts]), np.concatenate([*offsets, begins[-1:]]).astype(np.int64)
    )
