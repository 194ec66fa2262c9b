"""What robots sensed, as columns of a table of kept runs: scans as lists, exploration noise and odometry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from triform.evaluation.senses import Senses
from triform.recordings.description import LidarTable
from triform.types import BoolArray, IntArray, RangeArray, TriformError

#: Exploration noise, and odometry since the scan [m, m, rad].
_NOISE, _ODOMETRY = ("noise_x", "noise_y"), ("odometry_x", "odometry_y", "odometry_heading")
#: Lists of ranges [m] and of intensities, in single precision.
_LISTS = ("ranges", "intensities")
#: Columns of numbers whose bytes are stored apart.
SPLIT = (*_NOISE, *_ODOMETRY, *(f"{name}.list.element" for name in _LISTS))
#: All columns; ``lidar`` is the number of the robot's LiDAR in the description.
COLUMNS = ("lidar", *_NOISE, *_ODOMETRY, *_LISTS)


def column_types() -> dict[str, Any]:
    """Return the Arrow type of every column."""
    import pyarrow as pa

    lists = dict.fromkeys(_LISTS, pa.list_(pa.float32()))
    return {"lidar": pa.int32()} | dict.fromkeys((*_NOISE, *_ODOMETRY), pa.float64()) | lists


def make_columns(senses: Sequence[Senses], lidars: Sequence[int]) -> list[Any]:
    """Return what all robots sensed in one run as Arrow arrays with a row for each record and robot.

    Args:
        senses: What the robots of each kind sensed, B = 1.
        lidars: Number of the LiDAR of each kind.
    """
    import pyarrow as pa

    counts, records = [each.robots for each in senses], senses[0].active.shape[1]
    active = np.concatenate([each.active[0] for each in senses], axis=1).ravel()
    columns = [pa.array(np.tile(np.repeat(lidars, counts).astype(np.int32), records))]
    for name, width in (("noise", len(_NOISE)), ("odometry", len(_ODOMETRY))):
        values = np.concatenate([getattr(each, name)[0] for each in senses], axis=1)
        columns += [pa.array(values[..., k].ravel(), from_pandas=True) for k in range(width)]
    rays = np.tile(np.repeat([each.scan.rays for each in senses], counts), records)
    bright = np.tile(np.repeat([each.intensities is not None for each in senses], counts), records)
    for name, there in (("ranges", active), ("intensities", active & bright)):
        # Ranges stand for intensities that are not known, and are not written there.
        given = [each.ranges if getattr(each, name) is None else getattr(each, name) for each in senses]
        values = np.concatenate([each[0].reshape(records, -1) for each in given], axis=1).ravel()
        offsets = np.concatenate([[0], np.cumsum(np.where(there, rays, 0))])
        parts = pa.array(offsets, pa.int32()), pa.array(values[np.repeat(there, rays)])
        columns.append(pa.ListArray.from_arrays(*parts, mask=pa.array(~there)))
    return columns


def read_columns(table: Any, lidars: Sequence[LidarTable], records: int, robots: int, where: str) -> tuple[Senses, ...]:
    """Return what ``make_columns`` wrote; neighbours with one LiDAR are one kind.

    Args:
        table: Arrow table with ``COLUMNS``, one row for each record and robot.
        lidars: LiDARs by their numbers.
        records: Records of the run, T.
        robots: Robots of the run, N.
        where: Which run it is, for errors.

    Raises:
        TriformError: A robot has no LiDAR or several, or a scan has not as many values as its LiDAR has rays.
    """
    numbers = table["lidar"].to_numpy().reshape(records, robots)
    if not (numbers == numbers[0]).all() or not ((numbers[0] >= 0) & (numbers[0] < len(lidars))).all():
        raise TriformError(f"{where}: each robot has one LiDAR of the {len(lidars)} of the file, and this one has not")
    firsts = [0, *(np.flatnonzero(np.diff(numbers[0])) + 1).tolist()]
    scans = [lidars[number].scan for number in numbers[0, firsts].tolist()]
    counts = np.diff([*firsts, robots])
    rays = np.tile(np.repeat([scan.rays for scan in scans], counts), records)
    ranges, there = _read_lists(table["ranges"], rays, np.inf, where)
    levels, bright = _read_lists(table["intensities"], rays, 0.0, where)
    noise, odometry = (
        np.stack([table[each].to_numpy() for each in columns], axis=-1).reshape(1, records, robots, len(columns))
        for columns in (_NOISE, _ODOMETRY)
    )
    found, column = [], 0
    for scan, first, count in zip(scans, firsts, counts.tolist(), strict=True):
        own, width = slice(first, first + count), scan.rays * count
        seen, shown = (
            each.reshape(records, -1)[:, column : column + width].reshape(1, records, count, scan.rays)
            for each in (ranges, levels)
        )
        active, is_bright = (each.reshape(1, records, robots)[:, :, own] for each in (there, bright))
        kept = shown if is_bright.any() else None
        found.append(Senses(scan, active, seen, kept, noise[:, :, own], odometry[:, :, own]))
        column += width
    return tuple(found)


def _read_lists(column: Any, rays: IntArray, fill: float, where: str) -> tuple[RangeArray, BoolArray]:
    """Return the values of all lists behind one another, ``fill`` for lists that are null, and which are not.

    Args:
        column: The column.
        rays: How many values the list of each row has.
        fill: Stands for what is not there.
        where: Which run it is, for errors.
    """
    import pyarrow.compute as pc

    lengths = pc.fill_null(pc.list_value_length(column), 0).to_numpy()
    there = column.is_valid().to_numpy()
    if (lengths != np.where(there, rays, 0)).any():
        raise TriformError(f"{where}: a scan has another number of values than its LiDAR has rays")
    values = np.full(rays.sum(), fill, np.float32)
    values[np.repeat(there, rays)] = pc.list_flatten(column).to_numpy()
    return values, there
