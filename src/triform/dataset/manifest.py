"""The manifest of a data set: what was asked for, what made it, and a checksum of every finished shard."""

from __future__ import annotations

import json
import reprlib
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from triform.dataset.configuration import CollectionConfig
from triform.decode import checksum, decode_dataclass, decode_json
from triform.files import write_atomically
from triform.types import ConfigurationError, TriformError, require

MANIFEST = "manifest.json"
SHARDS = "shards"
_FORMAT = "triform-demonstrations"
#: Of manifests that are written; those of version 1, which have no checksum of their own, are read too.
_FORMAT_VERSION = 2
_MAKERS = ("numba", "numpy", "pyarrow", "triform")


@dataclass(frozen=True)
class Shard:
    """One finished shard file.

    Attributes:
        index: Its place in the data set.
        records: Records in it.
        cells: Occupied cells of all its maps.
        bytes: Size of the file.
        sha256: Checksum of the file.
    """

    index: int
    records: int
    cells: int
    bytes: int
    sha256: str

    def __post_init__(self) -> None:
        require(
            min(self.index, self.records, self.cells, self.bytes) >= 0,
            f"a shard has the counts {self.index}, {self.records}, {self.cells} and {self.bytes}",
        )


@dataclass(frozen=True)
class Manifest:
    """Everything known about a data set without opening its shards.

    It is a function of the configuration, the versions and the finished shards: it holds no dates and no
    durations, so collecting again gives the same file to the bit.

    Attributes:
        config: What was asked for.
        versions: Version of every package that decides the bytes.
        validation_runs: Runs held out for validation, ascending.
        shards: The finished shards, by index.
    """

    config: CollectionConfig
    versions: dict[str, str]
    validation_runs: tuple[int, ...]
    shards: tuple[Shard, ...] = ()

    def __post_init__(self) -> None:
        config, runs = self.config, self.validation_runs
        require(
            all(0 <= run < config.all_runs for run in runs) and list(runs) == sorted(set(runs)),
            "it holds out runs for validation that do not exist",
        )
        indices = [each.index for each in self.shards]
        require(
            indices == sorted(set(indices)) and all(index < config.shards for index in indices),
            f"it lists the shards {reprlib.repr(indices)} of {config.shards}",
        )
        for shard in self.shards:
            # A run has a row group at least, and a row group a byte: so no count is beyond what files can hold.
            count = len(held := config.shard_range(shard.index))
            if count <= shard.bytes:
                count = sum(-(-config.run_records(run) // config.group_records) for run in held)
            require(count <= shard.bytes, f"shard {shard.index} has {shard.bytes} bytes for {count} row groups")

    @property
    def complete(self) -> bool:
        """Whether every shard is finished."""
        return len(self.shards) == self.config.shards

    def with_shard(self, shard: Shard) -> Manifest:
        """The manifest with one more finished shard."""
        return replace(self, shards=tuple(sorted((*self.shards, shard), key=lambda each: each.index)))

    def to_json(self) -> dict[str, Any]:
        """The manifest as plain JSON values; ``complete``, ``counts`` and the file names only repeat the rest."""
        config = self.config
        values = {
            "complete": self.complete,
            "configuration": config.to_json(),
            "versions": self.versions,
            "counts": {
                "runs": config.all_runs,
                "roll_outs": config.runs,
                "placement_blocks": config.blocks,
                "records": config.records,
                "maps": config.maps,
                "shards": config.shards,
            },
            "validation_runs": list(self.validation_runs),
            "shards": [{"file": f"{SHARDS}/{shard_name(each.index)}", **asdict(each)} for each in self.shards],
        }
        return {"format": _FORMAT, "format_version": _FORMAT_VERSION, "sha256": checksum(values), **values}

    def save(self, folder: Path) -> None:
        """Write the manifest of the data set in ``folder``.

        Raises:
            TriformError: If that is not possible; the manifest before is then still there.
        """
        text = json.dumps(self.to_json(), indent=1, allow_nan=False) + "\n"
        write_atomically(folder / MANIFEST, text.encode())


def shard_name(index: int) -> str:
    """File name of a shard."""
    return f"shard-{index:05d}.parquet"


def shard_path(folder: Path, index: int) -> Path:
    """Path of a shard of the data set in ``folder``."""
    return folder / SHARDS / shard_name(index)


def new_manifest(config: CollectionConfig) -> Manifest:
    """The manifest of a data set of which no shard is finished, made by the installed packages."""
    versions = {name: version(name) for name in _MAKERS}
    return Manifest(config, versions, tuple(config.validation_runs().tolist()))


def load_manifest(folder: Path) -> Manifest:
    """Read the manifest of the data set in ``folder``.

    Raises:
        TriformError: If there is none, or it is damaged or of another format.
    """
    path = folder / MANIFEST
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise TriformError(f"{folder} is no data set: it holds no {MANIFEST}") from error
    except OSError as error:
        raise TriformError(f"{path} cannot be read: {error}") from error
    values = decode_json(data, str(path))
    if not isinstance(values, dict) or values.get("format") != _FORMAT:
        raise TriformError(f"{path} is not the manifest of a data set of demonstrations")
    del values["format"]
    found = values.pop("format_version", None)
    if type(found) is not int or not 1 <= found <= _FORMAT_VERSION:
        raise TriformError(
            f"{path} has format version {found!r}; this version of triform reads versions 1 to {_FORMAT_VERSION}"
        )
    if found == _FORMAT_VERSION and values.pop("sha256", None) != checksum(values):
        raise TriformError(f"{path} is damaged or was changed by hand: its checksum differs")
    try:
        manifest = _parse(values)
    except ConfigurationError as error:
        raise TriformError(f"{path} is damaged: {error}") from error
    repeated = manifest.to_json()
    if {key: repeated.get(key) for key in values} != values or len(repeated) != len(values) + 3:
        raise TriformError(f"{path} is damaged: its parts contradict each other")
    return manifest


def _parse(values: dict[str, Any]) -> Manifest:
    """The manifest that ``values`` describe; what they repeat, such as counts and file names, is not looked at.

    Raises:
        ConfigurationError: If a value is missing, of another type or impossible.
    """
    listed = values.get("shards")
    require(isinstance(listed, list) and all(isinstance(each, dict) for each in listed), "it lists no shards")
    shards = [{key: value for key, value in each.items() if key != "file"} for each in values["shards"]]
    described = {"config": values.get("configuration"), "shards": shards}
    described |= {key: values.get(key) for key in ("versions", "validation_runs")}
    return decode_dataclass(Manifest, described, "it")
