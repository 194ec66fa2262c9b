"""The manifest of a data set: what was asked for, what made it, and a checksum of every finished shard."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from triform.dataset.configuration import CollectionConfig, config_from_json
from triform.files import write_atomically
from triform.types import ConfigurationError, TriformError

MANIFEST = "manifest.json"
SHARDS = "shards"
_FORMAT = "triform-demonstrations"
_FORMAT_VERSION = 1
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
        return {
            "format": _FORMAT,
            "format_version": _FORMAT_VERSION,
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
        values = json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise TriformError(f"{folder} is no data set: it holds no {MANIFEST}") from error
    except (OSError, ValueError) as error:
        raise TriformError(f"{path} cannot be read: {error}") from error
    if not isinstance(values, dict) or values.get("format") != _FORMAT:
        raise TriformError(f"{path} is not the manifest of a data set of demonstrations")
    if values.get("format_version") != _FORMAT_VERSION:
        raise TriformError(
            f"{path} has format version {values.get('format_version')!r}; this version of triform reads "
            f"{_FORMAT_VERSION}"
        )
    try:
        manifest = _parse(values)
    except (ConfigurationError, KeyError, TypeError, AttributeError) as error:
        raise TriformError(f"{path} is damaged: {error}") from error
    if manifest.to_json() != values:
        raise TriformError(f"{path} is damaged: its parts contradict each other")
    return manifest


def _parse(values: dict[str, Any]) -> Manifest:
    config = config_from_json(values["configuration"])
    shards = tuple(Shard(**{key: value for key, value in each.items() if key != "file"}) for each in values["shards"])
    indices = [each.index for each in shards]
    if indices != sorted(set(indices)) or not set(indices) <= set(range(config.shards)):
        raise ConfigurationError(f"it lists the shards {indices} of {config.shards}")
    validation_runs = tuple(values["validation_runs"])
    if not set(validation_runs) <= set(range(config.all_runs)):
        raise ConfigurationError("it holds out runs for validation that do not exist")
    return Manifest(config, dict(values["versions"]), validation_runs, shards)
