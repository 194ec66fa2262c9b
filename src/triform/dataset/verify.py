"""Telling whole shards from damaged and foreign ones."""

from __future__ import annotations

from pathlib import Path

from triform.dataset.manifest import SHARDS, Manifest, Shard, shard_path
from triform.files import sha256
from triform.types import TriformError


def check_presence(folder: Path, manifest: Manifest) -> None:
    """Check that exactly the shards of the manifest are there, each of its size, without reading them.

    Raises:
        TriformError: If the data set is not complete, or a shard is missing, cut short, too long or foreign.
    """
    if not manifest.complete:
        raise TriformError(
            f"{folder} is not complete: {len(manifest.shards)} of {manifest.config.shards} shards are collected; "
            "run the same collection again to finish it"
        )
    for shard in manifest.shards:
        _check_size(shard_path(folder, shard.index), shard)
    expected = {shard_path(folder, shard.index) for shard in manifest.shards}
    for path in sorted((folder / SHARDS).glob("*.parquet")):
        if path not in expected:
            raise TriformError(f"{path} is no shard of this data set; move it elsewhere")


def check_shard(folder: Path, shard: Shard) -> None:
    """Check a shard to the byte.

    Raises:
        TriformError: If it is missing, of another size, or its checksum is not that of the manifest.
    """
    path = shard_path(folder, shard.index)
    _check_size(path, shard)
    try:
        found = sha256(path.read_bytes())
    except OSError as error:
        raise TriformError(f"{path} cannot be read: {error}") from error
    if found != shard.sha256:
        raise TriformError(
            f"{path} is damaged or foreign: its SHA-256 is not that of the manifest; "
            "delete it and run the same collection again to restore it"
        )


def _check_size(path: Path, shard: Shard) -> None:
    try:
        size = path.stat().st_size
    except OSError as error:
        raise TriformError(f"{path} is missing; run the same collection again to restore it") from error
    if size != shard.bytes:
        state = "truncated" if size < shard.bytes else "too long"
        raise TriformError(
            f"{path} is {state}: it has {size} bytes and the manifest says {shard.bytes}; "
            "delete it and run the same collection again to restore it"
        )
