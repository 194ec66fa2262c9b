"""Collecting a data set, shard by shard, in a way that may be stopped at any moment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from triform.dataset.configuration import CollectionConfig
from triform.dataset.demonstrate import demonstrate
from triform.dataset.manifest import (
    MANIFEST,
    SHARDS,
    Manifest,
    Shard,
    load_manifest,
    new_manifest,
    shard_path,
)
from triform.dataset.records import Records
from triform.dataset.sensing import sense
from triform.dataset.shards import encode
from triform.dataset.verify import check_shard
from triform.engines import Engine, LocalEngine, Report
from triform.files import cannot_write, exclusive, make_folder, remove_temporaries, sha256, write_atomically
from triform.types import TriformError

#: Called with the maps finished so far and all maps.
Progress = Callable[[int, int], None]


def collect(
    out: Path,
    config: CollectionConfig,
    progress: Progress | None = None,
    engine: Engine | None = None,
) -> Manifest:
    """Collect demonstrations into a folder, or finish a collection that was stopped there.

    Every shard is a function of the configuration and its index alone. It is written under a temporary name,
    synced, renamed, and then entered into the manifest, so whatever the moment at which the process is killed,
    the same call finishes the data set to the same bytes, with any engine and any number of workers.

    Args:
        out: Folder of the data set; created if need be.
        config: What to collect, for example ``PRESETS["paper"]``.
        progress: Called from this thread whenever some maps are finished, and once at the start.
        engine: Where shards are collected; the threads of this process if omitted. This process writes them.

    Returns:
        The manifest of the complete data set.

    Raises:
        TriformError: If the folder holds something else, a data set of another configuration or of other package
            versions, or a damaged shard; if it cannot be written; if the disk is full. What was finished before
            stays and can be continued.
    """
    engine = engine or LocalEngine()
    folder = Path(out)
    _prepare_folder(folder)
    with exclusive(folder):
        asked = new_manifest(config)
        manifest = _continued(folder, asked) if (folder / MANIFEST).exists() else asked
        missing = _missing_shards(folder, manifest)
        if missing and manifest.versions != asked.versions:
            raise TriformError(
                f"{folder} was begun with {manifest.versions} and cannot be continued with {asked.versions}; "
                "install those versions or give another folder"
            )
        remove_temporaries(folder)
        remove_temporaries(folder / SHARDS)
        finished = tuple(shard for shard in manifest.shards if shard.index not in missing)
        manifest = replace(manifest, shards=finished)
        manifest.save(folder)
        return _collect_shards(folder, manifest, missing, engine, progress)


def _prepare_folder(folder: Path) -> None:
    """Make the folders of a data set, unless something else is there."""
    try:
        foreign = not (folder / MANIFEST).exists() and any(
            not each.name.startswith(".") and each.name != SHARDS for each in folder.iterdir()
        )
    except FileNotFoundError:
        foreign = False
    except OSError as error:
        raise cannot_write(folder, error) from error
    if foreign:
        raise TriformError(f"{folder} is not empty and holds no data set; give a new or empty folder")
    make_folder(folder / SHARDS)


def _continued(folder: Path, asked: Manifest) -> Manifest:
    """The manifest in ``folder``, if it is that of the configuration asked for."""
    found = load_manifest(folder)
    before, now = found.config.to_json(), asked.config.to_json()
    different = [f"{key} {before[key]!r} instead of {now[key]!r}" for key in now if before[key] != now[key]]
    if different:
        raise TriformError(
            f"{folder} holds a data set of another configuration ({', '.join(different)}); "
            "ask for the same one to continue it, or give another folder"
        )
    return found


def _missing_shards(folder: Path, manifest: Manifest) -> list[int]:
    """Shards still to collect; those finished before are checked to the byte."""
    missing = set(range(manifest.config.shards))
    for shard in manifest.shards:
        if shard_path(folder, shard.index).exists():
            check_shard(folder, shard)
            missing.remove(shard.index)
    return sorted(missing)


def _collect_shards(
    folder: Path, manifest: Manifest, missing: list[int], engine: Engine, progress: Progress | None
) -> Manifest:
    done, total = sum(shard.records for shard in manifest.shards) * manifest.config.robots, manifest.config.maps

    def advance(maps: float) -> None:
        nonlocal done
        done += int(maps)
        if progress is not None:
            progress(done, total)

    advance(0)
    with closing(engine.run(CollectShard(manifest.config), missing, advance)) as collected:
        for _, (shard, data) in collected:
            write_atomically(shard_path(folder, shard.index), data)
            manifest = manifest.with_shard(shard)
            manifest.save(folder)
    return manifest


@dataclass(frozen=True)
class CollectShard:
    """The task of a collection: make one shard, in memory.

    Attributes:
        config: What is collected.
    """

    config: CollectionConfig

    def __call__(self, index: int, report: Report) -> tuple[Shard, bytes]:
        """The shard and its file; reports maps."""
        groups = []
        for group in _groups(self.config, index):
            groups.append(group)
            report(len(group) * self.config.robots)
        data = encode(groups, self.config)
        shard = Shard(
            index=index,
            records=sum(len(group) for group in groups),
            cells=sum(len(group.cells) for group in groups),
            bytes=len(data),
            sha256=sha256(data),
        )
        return shard, data


def _groups(config: CollectionConfig, index: int) -> Iterator[Records]:
    """The records of a shard, one row group after the other."""
    runs = config.shard_range(index)
    for run, (poses, commands) in zip(runs, demonstrate(config, runs), strict=True):
        for steps in config.groups(run):
            part = np.ascontiguousarray(poses[steps.start : steps.stop])
            cells, offsets = sense(part, config.footprint, config.scan, config.map)
            yield Records(
                run=np.full(len(steps), run, dtype=np.int32),
                step=np.array(steps, dtype=np.int32),
                poses=part,
                commands=commands[steps.start : steps.stop].reshape(-1, 3).astype(np.float32),
                cells=cells,
                offsets=offsets,
                map_size=config.map.size,
            )
