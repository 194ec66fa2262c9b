"""Kept runs: trajectories in Parquet, from which every measure is that of the run to the bit.

A file is a long table with one row per run, record and robot, sorted by these, each run in a row group of its own, and
a ``Description`` as JSON in its metadata. Where scans are kept, the rows have columns of what each robot sensed, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np

from triform.evaluation.metrics import RunTable
from triform.evaluation.rollout import Trajectory
from triform.evaluation.senses import Senses
from triform.files import cannot_write, open_atomically
from triform.recordings import sensed
from triform.recordings.description import Description, Descriptions, RunSetting, Source, decode_description
from triform.recordings.formats import first_line
from triform.report.output import prepare_file
from triform.report.tables import require_parquet
from triform.types import ConfigurationError, TriformError, is_plausible, require

#: Key of the description in the metadata of a file.
KEY = b"triform"
#: Columns of poses [m, m, rad] and of the body twists held from a record to the next [m/s, m/s, rad/s].
_POSE, _TWIST = ("x", "y", "heading"), ("v_x", "v_y", "omega")
#: All columns of a table without scans.
COLUMNS = ("run", "time", "robot", *_POSE, *_TWIST)
#: Times are Unix times at most, in units of the largest number of metres.
_LATEST = 1e6


class RunSink(Protocol):
    """Writes runs into one file."""

    def add(self, trajectory: Trajectory, setting: RunSetting, measures: RunTable) -> None:
        """Write runs, as ``RunWriter.add``."""
        ...

    def describe(self, settings: dict[str, Any]) -> None:
        """Say with which settings and controller the runs were made."""
        ...

    def close(self) -> None:
        """Write what is left, and the description."""
        ...

    def give_up(self) -> None:
        """Write nothing more."""
        ...


class RunWriter:
    """Writes runs one by one, so that no more than one batch of them is in memory."""

    def __init__(self, path: Path, file: IO[bytes], source: Source) -> None:
        """Begin a table.

        Args:
            path: Name of the file, for messages.
            file: Where to.
            source: Where poses come from.
        """
        self._path, self._file = path, file
        self._writer: Any = None
        self._scans = False
        self._descriptions = Descriptions(source)

    def add(self, trajectory: Trajectory, setting: RunSetting, measures: RunTable) -> None:
        """Write runs.

        Args:
            trajectory: B runs, either all or none of a file with what their robots sensed.
            setting: Their setting.
            measures: Their measures, one row per run; ``run`` is the index of the start, and of the others those are
                kept that poses alone cannot give. Empty if poses can give all.

        Raises:
            TriformError: The disk is full or fails.
        """
        robots = trajectory.poses.shape[2]
        if self._writer is None:
            self._begin(scans=bool(trajectory.senses))
        for run in range(len(trajectory.poses)):
            row = {name: column[run] for name, column in measures.items()}
            entry = self._descriptions.add(setting, robots, row)
            table = self._table(entry.run, trajectory.run(run), setting)
            try:
                self._writer.write_table(table, row_group_size=len(table))
            except OSError as error:
                raise cannot_write(self._path, error) from error

    def describe(self, settings: dict[str, Any]) -> None:
        """Say with which settings and controller the runs were made; plain JSON values, for people."""
        self._descriptions.settings = settings

    def close(self) -> None:
        """Write the description and the end of the file.

        Raises:
            TriformError: The disk is full or fails.
        """
        if self._writer is None:
            self._begin(scans=False)
        try:
            self._writer.add_key_value_metadata({KEY: self._descriptions.description.encode()})
            self._writer.close()
        except OSError as error:
            raise cannot_write(self._path, error) from error

    def give_up(self) -> None:
        """Write nothing more, also when the writer is deleted later."""
        if self._writer is not None:
            self._writer.is_open = False

    def _begin(self, scans: bool) -> None:
        """Begin the table, once it is known whether it holds scans."""
        import pyarrow as pa
        from pyarrow import parquet

        self._scans = scans
        kinds = {name: pa.int32() if name in ("run", "robot") else pa.float64() for name in COLUMNS}
        numbers = [*_POSE, *_TWIST]
        if scans:
            kinds |= sensed.column_types()
            numbers += sensed.SPLIT
        self._schema = pa.schema(list(kinds.items()))
        self._writer = parquet.ParquetWriter(
            self._file,
            self._schema,
            compression="zstd",
            use_dictionary=["run", "time", "robot", *["lidar"] * scans],
            use_byte_stream_split=numbers,
            write_page_checksum=True,
        )

    def _table(self, number: int, run: Trajectory, setting: RunSetting) -> Any:
        import pyarrow as pa

        require(bool(run.senses) == self._scans, f"{self._path} holds scans of all of its runs, or of none")
        records, robots = run.active.shape[1:]
        there = run.active[0]
        held = np.concatenate([run.commands[0], np.full((1, robots, 3), np.nan)])
        columns = [
            np.full(records * robots, number, np.int32),
            np.repeat(run.time, robots),
            np.tile(np.arange(robots, dtype=np.int32), records),
            *(np.where(there, run.poses[0, ..., k], np.nan).ravel() for k in range(3)),
            *(held[..., k].ravel() for k in range(3)),
        ]
        arrays = [pa.array(column, from_pandas=True) for column in columns]
        if self._scans:
            lidars = zip(setting.lidars, run.senses, strict=True)
            numbers = [self._descriptions.add_lidar(replace(lidar, scan=own.scan)) for lidar, own in lidars]
            arrays += sensed.make_columns(run.senses, numbers)
        return pa.table(arrays, schema=self._schema)


class Writers:
    """Writes every run into each of some files."""

    def __init__(self, writers: Sequence[RunSink]) -> None:
        """Take the writers of the files."""
        self._writers = writers

    def add(self, trajectory: Trajectory, setting: RunSetting, measures: RunTable) -> None:
        """Write runs, as ``RunWriter.add``."""
        for each in self._writers:
            each.add(trajectory, setting, measures)

    def describe(self, settings: dict[str, Any]) -> None:
        """Say with which settings and controller the runs were made."""
        for each in self._writers:
            each.describe(settings)


def check_kept(keep: Path | None, mcap: Path | None, scans: bool = False) -> None:
    """Refuse names of files by whose endings no reader would know them, and scans without a file.

    Raises:
        ConfigurationError: One has another ending than .parquet, the other than .mcap, or scans are for neither.
    """
    require(not scans or keep is not None or mcap is not None, "scans is given without keep or mcap, which hold them")
    for name, path, ending in (("keep", keep, ".parquet"), ("mcap", mcap, ".mcap")):
        require(path is None or path.suffix == ending, f"{name} is {path}; the name of its file ends in {ending}")


@contextmanager
def keep_runs(*paths: Path | None, source: Source = "simulation") -> Iterator[Writers]:
    """Give a writer of runs; the files are there once the block ends, and not at all if it fails.

    Args:
        paths: Where to: Parquet, or MCAP where the name ends in ``.mcap``; what is ``None`` is left out.
        source: Where poses come from.

    Raises:
        TriformError: A file cannot be written, or pyarrow is not installed.
        ModuleNotFoundError: foxglove-sdk is not installed, and a file is MCAP.
    """
    with ExitStack() as stack:
        yield Writers([stack.enter_context(_open_writer(path, source)) for path in paths if path is not None])


@contextmanager
def _open_writer(path: Path, source: Source) -> Iterator[RunSink]:
    """Give the writer of one file."""
    kind: Callable[[Path, IO[bytes], Source], RunSink] = RunWriter
    if path.suffix == ".mcap":
        from triform.recordings.mcap import McapWriter

        kind = McapWriter
    else:
        require_parquet()
    with open_atomically(prepare_file(path)) as file:
        writer = kind(path, file, source)
        try:
            yield writer
            writer.close()
        finally:
            writer.give_up()


class KeptRuns:
    """A file of kept runs, of which one at a time is in memory.

    Attributes:
        description: What the file says of them.
    """

    def __init__(self, path: Path, description: Description) -> None:
        """Take a file and its description."""
        self._path, self.description = path, description

    def __len__(self) -> int:
        return len(self.description.runs)

    def label(self, run: int) -> str:
        """Return which run of which file a run is."""
        return f"{self._path}, run {self.description.runs[run].run}"

    def setting(self, run: int) -> RunSetting:
        """Return the setting of a run.

        Raises:
            TriformError: It is damaged.
        """
        try:
            return self.description.setting(self.description.runs[run])
        except ConfigurationError as error:
            raise TriformError(f"{self.label(run)} cannot be read: {error}") from None

    @property
    def has_scans(self) -> bool:
        """Whether ``trajectory`` can read what the robots sensed."""
        return bool(self.description.lidars)

    def trajectory(self, run: int, scans: bool = False) -> Trajectory:
        """Read a run, B = 1.

        Args:
            run: Which of the file.
            scans: Whether to read what the robots sensed, too, where the file holds it.

        Raises:
            TriformError: Its records are damaged.
        """
        raise NotImplementedError


class ParquetRuns(KeptRuns):
    """A Parquet file of kept runs."""

    def __init__(self, path: Path, description: Description, file: Any) -> None:
        """Take an open file and its description."""
        super().__init__(path, description)
        self._file = file

    def trajectory(self, run: int, scans: bool = False) -> Trajectory:
        """Read a run, B = 1, as ``KeptRuns.trajectory``."""
        entry, where = self.description.runs[run], self.label(run)
        more = sensed.COLUMNS if scans and self.has_scans else ()
        with _readable(where):
            table = self._file.read_row_group(run, columns=[*COLUMNS, *more])
            columns = {name: table[name].to_numpy() for name in COLUMNS}
        robots, rows = np.arange(entry.robots), len(table)
        records = rows // max(1, entry.robots)
        time = columns["time"][:: max(1, entry.robots)]
        if (
            records < 2
            or rows != records * entry.robots
            or (columns["run"] != entry.run).any()
            or (columns["robot"] != np.tile(robots, records)).any()
            or (columns["time"] != np.repeat(time, entry.robots)).any()
            or not (np.diff(time) > 0).all()
            or not is_plausible(time / _LATEST)
        ):
            raise TriformError(f"{where}: there is not one row for each record and robot, in this order")
        shape = (1, records, entry.robots, 3)
        poses = np.stack([columns[name] for name in _POSE], axis=1).reshape(shape)
        commands = np.stack([columns[name] for name in _TWIST], axis=1).reshape(shape)[:, :-1]
        active = ~np.isnan(poses).any(axis=-1)
        if not (np.isnan(poses[~active]).all() and is_plausible(poses[active])):
            raise TriformError(f"{where}: a pose is not whole, or absurd")
        senses: tuple[Senses, ...] = ()
        if more:
            senses = sensed.read_columns(table, self.description.lidars, records, entry.robots, where)
        return Trajectory(time, poses, active, commands, senses)


def open_runs(path: Path) -> KeptRuns | None:
    """Open a file of kept runs; ``None`` if it is another Parquet file.

    Raises:
        TriformError: The file is damaged.
    """
    require_parquet()
    from pyarrow import parquet

    with _readable(str(path)):
        file = parquet.ParquetFile(path, page_checksum_verification=True)
        data, names = (file.metadata.metadata or {}).get(KEY), set(file.schema_arrow.names)
    if data is None:
        return None
    description = decode_description(data, str(path))
    columns = {*COLUMNS, *(sensed.COLUMNS if description.lidars else ())}
    if file.num_row_groups != len(description.runs) or not columns <= names:
        raise TriformError(f"{path} cannot be read: its rows are not those of its {len(description.runs)} runs")
    return ParquetRuns(path, description, file)


@contextmanager
def _readable(where: str) -> Iterator[None]:
    """Say in one sentence why a Parquet file cannot be read; errors of the system stay as they are."""
    import pyarrow as pa

    try:
        yield
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        if getattr(error, "errno", None) is not None:
            raise
        raise TriformError(f"{where} cannot be read: {first_line(error)}") from None
