"""Tables and arrays of recorded poses: CSV, Parquet and .npy, read as the tracks of robots."""

from __future__ import annotations

import codecs
import csv
import tokenize
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from triform.types import FloatArray, TriformError

#: Columns of a table of poses [s, any name, m, m, rad].
COLUMNS = ("time", "robot", "x", "y", "heading")
_NUMBERS = ("time", "x", "y", "heading")
#: The first of these that a table has tells its runs apart; the second one does in files of ``triform reproduce``.
_RUN_COLUMNS = ("run", "robots")
#: What other programs put between columns.
_SEPARATORS = {";": "semicolons", "\t": "tabs"}
#: A text has none of these characters in its first bytes.
_NO_TEXT = bytes(set(range(32)) - set(b"\t\n\v\f\r"))
_FIRST_BYTES, _CHUNK = 4096, 1 << 20
#: Nothing is recorded later, in seconds of any clock, or farther away, in metres or radians.
_LATEST, _FARTHEST = 1e12, 1e6
#: Cells that stand for no measurement.
_MISSING = ("", "NaN", "nan", "NA", "null")


@dataclass(frozen=True)
class Track:
    """Where one robot was seen.

    Attributes:
        time: Strictly growing moments [s], shape (T,).
        poses: Poses (x, y, heading) in the world frame [m, m, rad], all finite, shape (T, 3).
    """

    time: FloatArray
    poses: FloatArray


@dataclass(frozen=True)
class RawRun:
    """The tracks of one run as they were recorded; every robot has moments of its own.

    Attributes:
        label: Which run of which file it is.
        tracks: The robots by name.
    """

    label: str
    tracks: dict[str, Track]


def natural(name: str) -> tuple[int, str]:
    """Sort key of names that puts 2 before 10."""
    return len(name), name


def make_track(where: str, time: FloatArray, poses: FloatArray) -> Track:
    """Return what was seen of one robot, in order and without repetitions.

    Args:
        where: File and robot, for a message.
        time: Moments in any order [s], shape (T,).
        poses: Poses, shape (T, 3); those that are not finite were not seen.

    Raises:
        TriformError: The robot is at two places at the same moment, or a number is no place or moment at all.
    """
    seen = np.isfinite(poses).all(axis=1)
    time, poses = time[seen], poses[seen]
    absurd = np.flatnonzero((np.abs(time) > _LATEST) | (np.abs(poses) > _FARTHEST).any(axis=1))
    if len(absurd):
        x, y, heading = poses[absurd[0]]
        raise TriformError(f"{where} is at ({x:.4g} m, {y:.4g} m, {heading:.4g} rad) at time {time[absurd[0]]:.15g} s")
    order = np.argsort(time, kind="stable")
    time, poses = time[order], poses[order]
    repeated = 1 + np.flatnonzero(np.diff(time) == 0)
    contradictory = repeated[(poses[repeated] != poses[repeated - 1]).any(axis=1)]
    if len(contradictory):
        raise TriformError(f"{where} is at two places at time {time[contradictory[0]]:.15g} s")
    return Track(np.delete(time, repeated), np.delete(poses, repeated, axis=0))


def wide_run(label: str, time: FloatArray, robots: Sequence[str], poses: FloatArray) -> RawRun:
    """Return the run of robots that were recorded at the same moments, poses of shape (T, N, 3)."""
    tracks = {name: make_track(f"{label}: robot {name}", time, poses[:, i]) for i, name in enumerate(robots)}
    return RawRun(label, tracks)


def frame_run(label: str, seen: Mapping[tuple[str, str], Sequence[tuple[float, FloatArray]]]) -> RawRun:
    """Return the run of robots whose frames were recorded: the children of the frame that has no parent.

    Args:
        label: Which run of which file it is.
        seen: Times [s] and poses (x, y, heading) of every frame in its parent, by parent and child.

    Raises:
        TriformError: There is no frame, or several have no parent, so that nothing says where robots are to each other.
    """
    children = {child for _, child in seen}
    roots = sorted({parent for parent, _ in seen} - children)
    if len(roots) != 1:
        reason = f"the frames {' and '.join(map(repr, roots[:2]))} have no parent" if roots else "no frame is a root"
        raise TriformError(f"{label}: {reason}; poses of all robots in one frame are needed")
    return RawRun(
        label,
        {
            child: make_track(f"{label}: robot {child}", *(np.array(each) for each in zip(*rows, strict=True)))
            for (parent, child), rows in seen.items()
            if parent == roots[0]
        },
    )


def planar_pose(translation: Any, rotation: Any) -> FloatArray:
    """Return the pose (x, y, heading) of a vector and a quaternion, messages with fields x, y, z and w."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    return np.array([translation.x, translation.y, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))])


def read_array(path: Path, rate: float | None) -> list[RawRun]:
    """Read an array of poses, shape (T, N, 3), or (B, T, N, 3) of many runs, from ``.npy``; it is never unpickled.

    Args:
        path: The file.
        rate: Records per second [Hz].

    Raises:
        TriformError: The file holds something else, or ``rate`` is not given.
    """
    if rate is None:
        raise TriformError(f"{path} says nothing about time; rate, its records per second, is needed")
    try:
        with path.open("rb") as file:
            values = np.lib.format.read_array(file, allow_pickle=False)
    except (ValueError, EOFError, MemoryError, tokenize.TokenError) as error:
        raise TriformError(f"{path} is not an .npy file of numbers: {first_line(error)}") from None
    if values.dtype.kind not in "fiu" or values.ndim not in (3, 4) or values.shape[-1] != 3:
        raise TriformError(
            f"{path} holds {values.dtype} of shape {values.shape}; poses of shape (T, N, 3) or (B, T, N, 3) are needed"
        )
    if values.size == 0:
        raise TriformError(f"{path} holds no pose: its shape is {values.shape}")
    runs = np.asarray(values if values.ndim == 4 else values[None], dtype=np.float64)
    labels = [str(path)] if values.ndim == 3 else [f"{path}, run {run}" for run in range(len(runs))]
    time = np.arange(runs.shape[1]) / rate
    robots = [str(robot) for robot in range(runs.shape[2])]
    return [wide_run(label, time, robots, poses) for label, poses in zip(labels, runs, strict=True)]


def encoding_of(path: Path) -> str:
    """Return how to read a text file: as UTF-8 if it is that, else byte by byte, as Latin-1.

    Nothing but names can be outside ASCII, so names in any encoding leave a file readable, and distinct.

    Raises:
        TriformError: The file is no text.
    """
    decoder = codecs.getincrementaldecoder("utf-8-sig")()
    with path.open("rb") as file:
        piece = file.read(_FIRST_BYTES)
        if len(piece.translate(None, _NO_TEXT)) < len(piece):
            raise TriformError(f"{path} cannot be read: it is no text")
        try:
            while piece:
                decoder.decode(piece)
                piece = file.read(_CHUNK)
            decoder.decode(b"", final=True)
        except UnicodeDecodeError:
            return "latin-1"
    return "utf-8-sig"


def require_commas(path: Path, headings: Sequence[str]) -> None:
    """Refuse a file whose first line is not cut by commas.

    Raises:
        TriformError: Another separator is in the first of its cells.
    """
    for separator, name in _SEPARATORS.items():
        if headings and separator in headings[0]:
            raise TriformError(f"{path} has {name} between its columns; commas are needed, and points in numbers")


def read_csv(path: Path) -> list[RawRun]:
    """Read a table of poses from CSV with one line of headings.

    Raises:
        TriformError: A column is missing or a cell is no number; line and column are named.
    """
    encoding = encoding_of(path)
    with path.open(newline="", encoding=encoding) as file:
        reader = csv.reader(file)
        names = [cell.strip() for cell in next((row for row in reader if row), [])]
        lines = reader.line_num
    require_commas(path, names)
    kept = _kept(path, names)
    wanted = {names.index(name): name for name in kept}
    table = read_cells(path, encoding, lines, len(names), wanted, [name for name in kept if name not in _NUMBERS])
    return _long_runs(path, table)


def read_parquet(path: Path) -> list[RawRun]:
    """Read a table of poses from Parquet.

    Raises:
        TriformError: The file is no readable Parquet file, a column is missing, or its values are no numbers.
    """
    import pyarrow as pa
    from pyarrow import parquet

    try:
        kept = _kept(path, parquet.read_schema(path).names)
        table = parquet.read_table(path, columns=kept)
    except pa.ArrowException as error:
        raise TriformError(f"{path} cannot be read: {first_line(error)}") from None
    for index, name in enumerate(table.column_names):
        kind = pa.float64() if name in _NUMBERS else pa.string()
        try:
            table = table.set_column(index, name, table[name].cast(kind))
        except pa.ArrowException:
            needed = "numbers are" if name in _NUMBERS else "a name or a number is"
            raise TriformError(f"{path}, column {name}, holds {table[name].type}; {needed} needed") from None
        if name not in ("x", "y", "heading") and table[name].null_count:
            row = np.argmax(table[name].is_null().to_numpy())
            raise TriformError(f"{path}, row {row + 1}, column {name}, is empty")
    return _long_runs(path, table)


def read_cells(
    path: Path, encoding: str, lines: int, width: int, wanted: Mapping[int, str], texts: Sequence[str] = ()
) -> Any:
    """Read columns of a CSV file that may be very long.

    Args:
        path: The file.
        encoding: Its encoding.
        lines: Lines above the values.
        width: Number of columns.
        wanted: Name of every column that is read, by its place; ``time`` and ``texts`` must have no empty cells.
        texts: Names of the columns that hold text; the others hold numbers.

    Returns:
        Arrow table with the wanted columns; numbers that are missing are null.

    Raises:
        TriformError: A line is too long or too short or a cell is no number; line and column are named.
    """
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    names = [wanted.get(index, f"#{index}") for index in range(width)]
    try:
        table = arrow_csv.read_csv(
            path,
            read_options=arrow_csv.ReadOptions(
                column_names=names, skip_rows=lines, encoding=encoding.removesuffix("-sig")
            ),
            convert_options=arrow_csv.ConvertOptions(
                include_columns=list(wanted.values()),
                column_types={name: pa.string() if name in texts else pa.float64() for name in wanted.values()},
                null_values=list(_MISSING),
                strings_can_be_null=True,
            ),
        )
    except pa.ArrowException as error:
        reason = first_line(error)
    else:
        if not any(table[name].null_count for name in ("time", *texts)):
            return table
        reason = "a cell of time or of a name is empty"
    wrong = _first_bad_line(path, encoding, lines, width, wanted, texts)
    raise TriformError(wrong or f"{path} cannot be read: {reason}")


def _first_bad_line(
    path: Path, encoding: str, lines: int, width: int, wanted: Mapping[int, str], texts: Sequence[str]
) -> str | None:
    """Say what is wrong with the first line that cannot be read; ``None`` if there is no such line."""
    empty = True
    with path.open(newline="", encoding=encoding) as file:
        reader = csv.reader(file)
        for row in reader:
            if reader.line_num <= lines or not row:
                continue
            empty = False
            if len(row) != width:
                return f"{path}, line {reader.line_num}: {len(row)} columns; {width} are needed"
            for index, name in wanted.items():
                cell = row[index].strip()
                if cell in _MISSING and (name == "time" or name in texts):
                    return f"{path}, line {reader.line_num}, column {name}, is empty"
                if name not in texts and not (cell in _MISSING or _is_number(cell)):
                    return f"{path}, line {reader.line_num}, column {name}: {cell!r} is not a number"
    return f"{path} holds no poses below its headings" if empty else None


def first_line(error: Exception) -> str:
    """Return the first line of what an error says."""
    return str(error).partition("\n")[0]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _kept(path: Path, names: Sequence[str]) -> list[str]:
    """Return which columns of a table are read.

    Raises:
        TriformError: A column is missing or there twice.
    """
    for name in COLUMNS:
        if names.count(name) != 1:
            raise TriformError(
                f"{path}: a table of poses needs the columns {', '.join(COLUMNS)}, each once; "
                f"there {'is no' if name not in names else 'are several'} {name}"
            )
    return [*COLUMNS, *[name for name in _RUN_COLUMNS if names.count(name) == 1][:1]]


def _long_runs(path: Path, table: Any) -> list[RawRun]:
    """Cut a table with one row per robot and moment into runs and robots."""
    time, *pose = (table[name].to_numpy() for name in _NUMBERS)
    poses = np.stack(pose, axis=1)
    if not np.isfinite(time).all():
        row = int(np.argmin(np.isfinite(time)))
        raise TriformError(f"{path}, row {row + 1}, column time: {time[row]} is not a finite number")
    of_robot, robots = _codes(table["robot"])
    of_run, runs = np.zeros(len(time), dtype=np.int64), [""]
    if table.num_columns > len(COLUMNS):
        of_run, runs = _codes(table[table.column_names[-1]])
    group = of_run * len(robots) + of_robot
    order = np.argsort(group, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(group[order])) + 1) if len(order) else []
    found: dict[str, dict[str, Track]] = {}
    for rows in parts:
        run, robot = runs[of_run[rows[0]]], robots[of_robot[rows[0]]]
        label = f"{path}, run {run}" if run else str(path)
        found.setdefault(label, {})[robot] = make_track(f"{label}: robot {robot}", time[rows], poses[rows])
    return [RawRun(label, found[label]) for label in sorted(found, key=natural)]


def _codes(column: Any) -> tuple[Any, list[str]]:
    """Return a number for every row of a column of names, and the names by these numbers."""
    import pyarrow.compute as pc

    encoded = pc.utf8_trim_whitespace(column.combine_chunks()).dictionary_encode()
    return encoded.indices.to_numpy().astype(np.int64), encoded.dictionary.to_pylist()
