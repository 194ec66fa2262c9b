"""Reading a data set as a stream of shuffled batches."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from triform.dataset.manifest import Manifest, load_manifest, shard_path
from triform.dataset.records import Records, concatenate
from triform.dataset.shards import ShardFile
from triform.dataset.verify import check_presence, check_shard
from triform.types import require

Split = Literal["train", "validation"]


@dataclass(frozen=True)
class _Group:
    """One Parquet row group."""

    shard: int
    index: int
    records: int


class Demonstrations:
    """A complete data set, opened for reading.

    No byte is used unchecked: opening compares the files' sizes with the manifest, and a shard's checksum is
    compared before it is first read.
    """

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        """Use ``open`` instead."""
        self._folder = folder
        self._manifest = manifest
        self._shards: dict[int, ShardFile] = {}
        held_out = set(manifest.validation_runs)
        self._groups: dict[str, list[_Group]] = {"train": [], "validation": []}
        for shard in range(manifest.config.shards):
            index = 0
            for run in manifest.config.shard_range(shard):
                for steps in manifest.config.groups(run):
                    split = "validation" if run in held_out else "train"
                    self._groups[split].append(_Group(shard, index, len(steps)))
                    index += 1

    @classmethod
    def open(cls, path: Path) -> Demonstrations:
        """Open the data set in a folder.

        Raises:
            TriformError: If there is none, it is not complete, or a file is missing, of the wrong size or foreign.
        """
        folder = Path(path)
        manifest = load_manifest(folder)
        check_presence(folder, manifest)
        return cls(folder, manifest)

    @property
    def manifest(self) -> Manifest:
        """Configuration, versions, split and checksums."""
        return self._manifest

    def verify(self) -> None:
        """Check every shard to the byte.

        Raises:
            TriformError: If one is truncated, damaged or foreign; it is named.
        """
        check_presence(self._folder, self._manifest)
        for shard in self._manifest.shards:
            check_shard(self._folder, shard)

    def records(self, split: Split) -> int:
        """Number of records in a split."""
        return sum(group.records for group in self._groups[split])

    def batch_count(self, split: Split, batch_records: int) -> int:
        """Number of batches in one epoch, the last of which may be smaller."""
        return -(-self.records(split) // batch_records)

    def batches(
        self,
        split: Split,
        batch_records: int,
        seed: int = 0,
        epoch: int = 0,
        start: int = 0,
        shuffle: bool = True,
        pool_records: int = 32_768,
    ) -> Iterator[Records]:
        """Yield every record of a split once, in batches.

        Row groups from anywhere in the data set are drawn in random order into a pool, and the records of a pool
        are shuffled; the next pool is read meanwhile. So memory holds two pools (three for a moment), however large
        the data set is. Order and batches are a function of the arguments alone: starting at batch ``k`` gives
        what an uninterrupted epoch would have given from batch ``k`` on.

        Args:
            split: ``"train"`` or ``"validation"``.
            batch_records: Records in a batch; the last of an epoch may be smaller.
            seed: Decides the order, together with ``epoch``.
            epoch: Number of the epoch; each has its own order.
            start: First batch to yield.
            shuffle: Whether to shuffle; otherwise records come as they were collected.
            pool_records: Records shuffled together, at least one row group.

        Raises:
            ConfigurationError: If an argument is not allowed.
            TriformError: If a shard is damaged; it is named.
        """
        require(split in self._groups, f"split is {split!r}; it must be 'train' or 'validation'")
        require(batch_records >= 1, f"batch_records is {batch_records}; at least 1 is needed")
        require(pool_records >= 1, f"pool_records is {pool_records}; at least 1 is needed")
        require(min(seed, epoch) >= 0, f"seed {seed} or epoch {epoch} is negative")
        count = self.batch_count(split, batch_records)
        require(0 <= start <= count, f"start is {start}; it must lie in [0, {count}]")
        key = (seed, epoch) if shuffle else None
        return self._stream(split, batch_records, key, start, pool_records)

    def _stream(
        self, split: Split, batch_records: int, key: tuple[int, int] | None, start: int, pool_records: int
    ) -> Iterator[Records]:
        pools = self._pools(split, key, pool_records)
        sizes = [sum(group.records for group in pool) for pool in pools]
        skipped = start * batch_records
        first = int(np.searchsorted(np.cumsum(sizes), skipped, side="right"))
        begin = skipped - sum(sizes[:first])
        rest: Records | None = None
        with ThreadPoolExecutor(1, thread_name_prefix="read") as reader:
            coming = [reader.submit(self._load, pools[first], key, first)] if first < len(pools) else []
            for number in range(first, len(pools)):
                pool = coming.pop().result()
                if number + 1 < len(pools):
                    coming.append(reader.submit(self._load, pools[number + 1], key, number + 1))
                if begin:
                    pool, begin = pool.part(begin, len(pool)), 0
                if rest is not None:
                    pool = concatenate([rest, pool])
                whole = len(pool) - len(pool) % batch_records
                for at in range(0, whole, batch_records):
                    yield pool.part(at, at + batch_records)
                rest = pool.part(whole, len(pool)) if whole < len(pool) else None
        if rest is not None:
            yield rest

    def _pools(self, split: Split, key: tuple[int, int] | None, pool_records: int) -> list[list[_Group]]:
        """Row groups in the order of reading, cut into pools."""
        groups = self._groups[split]
        order = range(len(groups)) if key is None else np.random.default_rng([*key, 0]).permutation(len(groups))
        pools: list[list[_Group]] = []
        filled = pool_records
        for index in order:
            if filled >= pool_records:
                pools.append([])
                filled = 0
            pools[-1].append(groups[index])
            filled += groups[index].records
        return pools

    def _load(self, pool: Sequence[_Group], key: tuple[int, int] | None, number: int) -> Records:
        """Read the row groups of a pool, each file opened once, and shuffle their records."""
        by_shard: dict[int, list[int]] = defaultdict(list)
        for group in pool:
            by_shard[group.shard].append(group.index)
        records = concatenate([self._shard(shard).read(sorted(groups)) for shard, groups in sorted(by_shard.items())])
        if key is None:
            return records
        return records.take(np.random.default_rng([*key, number + 1]).permutation(len(records)))

    def _shard(self, index: int) -> ShardFile:
        """A shard whose checksum was compared."""
        if index not in self._shards:
            check_shard(self._folder, self._manifest.shards[index])
            self._shards[index] = ShardFile(shard_path(self._folder, index), self._manifest.config)
        return self._shards[index]
