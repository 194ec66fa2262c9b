"""Shard files: records as Parquet, which pandas and pyarrow open.

| column   | type                        |                                                              |
|----------|-----------------------------|--------------------------------------------------------------|
| run      | int32                       | run the record belongs to                                    |
| step     | int32                       | place of the record in its run                               |
| kind     | string                      | ``roll-out`` or ``placement``                                |
| poses    | fixed list of 3 N float64   | x, y, heading of robot 0, 1, ... [m, m, rad]                 |
| commands | fixed list of 3 N float32   | u_x, u_y, omega of robot 0, 1, ... [m/s, m/s, rad/s]         |
| cells    | list of N lists of integers | occupied cells ``row * W + column`` of every robot's map     |

Poses keep all their bits, so that maps can be made again from them exactly, for example for another map size.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from triform.dataset.configuration import CollectionConfig
from triform.dataset.records import Records
from triform.dataset.sensing import cell_dtype
from triform.types import TriformError

ROLL_OUT = "roll-out"
PLACEMENT = "placement"
_WRITING: dict[str, Any] = {
    "compression": "zstd",
    "compression_level": 3,
    "use_dictionary": ["kind"],
    "column_encoding": {
        "run": "DELTA_BINARY_PACKED",
        "step": "DELTA_BINARY_PACKED",
        "poses.list.element": "BYTE_STREAM_SPLIT",
        "commands.list.element": "BYTE_STREAM_SPLIT",
        "cells.list.element.list.element": "DELTA_BINARY_PACKED",
    },
}


def schema(config: CollectionConfig) -> Any:
    """Arrow schema of a data set's shards."""

    def column(name: str, kind: Any) -> Any:
        return pa.field(name, kind, nullable=False)

    cell = pa.from_numpy_dtype(cell_dtype(config.map))
    return pa.schema(
        [
            column("run", pa.int32()),
            column("step", pa.int32()),
            column("kind", pa.string()),
            column("poses", pa.list_(column("element", pa.float64()), 3 * config.robots)),
            column("commands", pa.list_(column("element", pa.float32()), 3 * config.robots)),
            column("cells", pa.list_(column("element", pa.list_(column("element", cell))))),
        ]
    )


def encode(groups: Iterable[Records], config: CollectionConfig) -> bytes:
    """Write records as one Parquet file in memory, one row group for each item of ``groups``."""
    sink = pa.BufferOutputStream()
    form = schema(config)
    with pq.ParquetWriter(sink, form, **_WRITING) as writer:
        for group in groups:
            writer.write_table(_table(group, config, form), row_group_size=len(group))
    return bytes(sink.getvalue())


def _table(records: Records, config: CollectionConfig, form: Any) -> Any:
    kinds = [ROLL_OUT if config.is_roll_out(run) else PLACEMENT for run in records.run]
    maps = pa.ListArray.from_arrays(
        pa.array(records.offsets, pa.int32()), pa.array(records.cells), type=form.field("cells").type.value_type
    )
    per_record = pa.array(np.arange(0, len(maps) + 1, records.robots), pa.int32())
    columns: list[Any] = [
        pa.array(records.run),
        pa.array(records.step),
        pa.array(kinds, pa.string()),
        pa.FixedSizeListArray.from_arrays(pa.array(records.poses.reshape(-1)), type=form.field("poses").type),
        pa.FixedSizeListArray.from_arrays(pa.array(records.commands.reshape(-1)), type=form.field("commands").type),
        pa.ListArray.from_arrays(per_record, maps, type=form.field("cells").type),
    ]
    return pa.Table.from_arrays(columns, schema=form)


class ShardFile:
    """One shard opened for reading."""

    def __init__(self, path: Path, config: CollectionConfig) -> None:
        """Read the footer of a shard whose checksum was found right.

        Raises:
            TriformError: If its columns are not those of the configuration.
        """
        self._path = path
        self._config = config
        try:
            self._metadata = pq.read_metadata(path)
            matches = self._metadata.schema.to_arrow_schema().equals(schema(config))
        except (pa.ArrowException, OSError) as error:
            raise TriformError(f"{path} cannot be read: {error}") from error
        if not matches:
            raise TriformError(f"{path} does not have the columns of its manifest's configuration")

    def read(self, groups: list[int]) -> Records:
        """Read some row groups, in the given order.

        Raises:
            TriformError: If the file cannot be read.
        """
        columns = ["run", "step", "poses", "commands", "cells"]
        try:
            with pq.ParquetFile(self._path, metadata=self._metadata) as file:
                table = file.read_row_groups(groups, columns=columns, use_threads=False).combine_chunks()
        except (pa.ArrowException, OSError) as error:
            raise TriformError(f"{self._path} cannot be read: {error}") from error
        return _decode(table, self._config)


def _decode(table: Any, config: CollectionConfig) -> Records:
    def numbers(name: str) -> Any:
        return table.column(name).chunk(0)

    maps = numbers("cells").flatten()
    offsets = maps.offsets.to_numpy().astype(np.int64)
    return Records(
        run=numbers("run").to_numpy(),
        step=numbers("step").to_numpy(),
        poses=numbers("poses").flatten().to_numpy().reshape(-1, config.robots, 3),
        commands=numbers("commands").flatten().to_numpy().reshape(-1, 3),
        cells=maps.flatten().to_numpy(),
        offsets=offsets - offsets[0],
        map_size=config.map.size,
    )
