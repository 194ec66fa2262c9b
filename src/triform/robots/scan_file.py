"""Scans that ``triform drive`` recorded, and how bright their returns are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from triform.files import refuse_device
from triform.types import FloatArray, TriformError

#: File of a recording that holds its scans.
SCANS_FILE = "scans.csv"
#: Distances at which intensities are compared [m].
DISTANCES = (0.0, 0.5, 1.0, 2.0, 4.0)


def scan_columns(rays: int) -> tuple[str, ...]:
    """Return the columns of a file of scans: two times [s], ranges [m], and intensities, ``nan`` if not known."""
    numbers = range(rays)
    return ("started", "ended", *(f"range_{k}" for k in numbers), *(f"intensity_{k}" for k in numbers))


@dataclass(frozen=True)
class RecordedScans:
    """The scans of one robot.

    Attributes:
        started: Unix time at which each scan began, shape (T,) [s].
        ended: Unix time at which each scan ended, shape (T,) [s].
        ranges: Ranges as the LiDAR measured them, shape (T, R) [m]; REP 117 for what is no range.
        intensities: How bright these returns are, in the LiDAR's own scale, shape (T, R); ``NaN`` if not known.
    """

    started: FloatArray
    ended: FloatArray
    ranges: FloatArray
    intensities: FloatArray

    def summarise(self, shares: Sequence[float]) -> list[tuple[float, int, FloatArray]]:
        """Tell how bright returns are, by their distance.

        Args:
            shares: Shares of the returns, between 0 and 1.

        Returns:
            For each stretch of ``DISTANCES`` with returns: where it begins [m], how many returns it has, and the
            intensity that each share of them does not exceed, of the shape of ``shares``.
        """
        told = np.isfinite(self.ranges) & np.isfinite(self.intensities)
        ranges, intensities = self.ranges[told], self.intensities[told]
        stretch = np.searchsorted(DISTANCES, ranges, side="right") - 1
        return [
            (begin, int(mine.sum()), np.quantile(intensities[mine], shares))
            for index, begin in enumerate(DISTANCES)
            if (mine := stretch == index).any()
        ]


def read_scans(folder: Path) -> RecordedScans:
    """Read the scans of a recording of ``triform drive``.

    Args:
        folder: The folder that ``--record`` named.

    Raises:
        TriformError: There is no such recording, or it holds no scans.
    """
    path = folder / SCANS_FILE
    try:
        refuse_device(path)
        with path.open(encoding="utf-8") as file:
            columns = tuple(file.readline().strip().split(","))
            rays = (len(columns) - 2) // 2
            if columns != scan_columns(rays):
                raise TriformError(f"{path} has other columns than the scans of a recording of triform drive")
            # A drive that was killed, or a full disk, leaves half a line.
            lines = [line for line in file if line.endswith("\n")]
        rows = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.zeros((0, len(columns)))
    except OSError as error:
        raise TriformError(f"{path} cannot be read: {(error.strerror or str(error)).lower()}") from None
    except ValueError as error:
        raise TriformError(f"{path} holds something else than rows of numbers: {str(error).split(';')[0]}") from None
    if rows.size == 0:
        raise TriformError(f"{path} holds no scan")
    if rows.shape[1] != len(columns):
        raise TriformError(f"{path} has {rows.shape[1]} numbers in a row under {len(columns)} columns")
    return RecordedScans(rows[:, 0], rows[:, 1], rows[:, 2 : 2 + rays], rows[:, 2 + rays :])
