"""Stopped, killed, continued, refused."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from triform import files
from triform.dataset import Demonstrations, collect, load_manifest
from triform.engines import LocalEngine
from triform.files import exclusive
from triform.types import TriformError

from .conftest import SMALL, contents

#: Collects SMALL and kills itself, as by the power switch, at the n-th request to sync to the disk.
_KILL_AT_SYNC = """
import json, os, signal, sys
from pathlib import Path
from triform.dataset import collect
from triform.dataset.configuration import config_from_json
from triform.engines import LocalEngine
calls, sync = 0, os.fsync
def counting(descriptor):
    global calls
    calls += 1
    if calls == int(sys.argv[3]):
        os.kill(os.getpid(), signal.SIGKILL)
    sync(descriptor)
os.fsync = counting
collect(Path(sys.argv[1]), config_from_json(json.loads(sys.argv[2])), engine=LocalEngine(1))
"""

#: Collects SMALL with two workers and says when something is finished.
_TALK = """
import json, sys
from pathlib import Path
from triform.dataset import collect
from triform.dataset.configuration import config_from_json
from triform.engines import LocalEngine
config = config_from_json(json.loads(sys.argv[2]))
collect(Path(sys.argv[1]), config, engine=LocalEngine(2), progress=lambda done, total: print(done, total, flush=True))
"""


def start_script(script: str, folder: Path, *arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", script, str(folder), json.dumps(SMALL.to_json()), *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


@pytest.mark.parametrize("workers", [2, 5])
def test_the_bytes_do_not_depend_on_the_workers(tmp_path: Path, small_folder: Path, workers: int) -> None:
    collect(tmp_path, SMALL, engine=LocalEngine(workers))
    assert contents(tmp_path) == contents(small_folder)


def test_killed_at_any_sync_and_continued_gives_the_same_bytes(tmp_path: Path, small_folder: Path) -> None:
    # Every run syncs the manifest and its folder first (1, 2), then a shard, its folder (3, 4), the manifest and its
    # folder (5, 6), the next shard: so this kills before a manifest, a shard and a list entry is complete.
    finished = []
    for at in (1, 2, 4, 5, 8, 3):
        process = start_script(_KILL_AT_SYNC, tmp_path, at)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
        finished.append(len(load_manifest(tmp_path).shards) if (tmp_path / "manifest.json").exists() else None)
    assert finished[0] is None
    assert 0 < finished[-1] < SMALL.shards
    assert list(tmp_path.rglob(".*.tmp"))
    with pytest.raises(TriformError, match=r"is not complete: \d of \d+ shards"):
        Demonstrations.open(tmp_path)
    assert collect(tmp_path, SMALL, engine=LocalEngine(2)).complete
    assert contents(tmp_path) == contents(small_folder)


def test_killed_from_outside_and_continued_gives_the_same_bytes(tmp_path: Path, small_folder: Path) -> None:
    process = start_script(_TALK, tmp_path)
    assert process.stdout is not None
    assert process.stdout.readline() == f"0 {SMALL.maps}\n"
    process.stdout.readline()
    process.kill()
    process.communicate()
    collect(tmp_path, SMALL, engine=LocalEngine(1))
    assert contents(tmp_path) == contents(small_folder)


def test_interrupted_and_continued_gives_the_same_bytes(tmp_path: Path, small_folder: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        if done > total / 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path, SMALL, engine=LocalEngine(2), progress=interrupt)
    assert 0 < len(load_manifest(tmp_path).shards) < SMALL.shards
    collect(tmp_path, SMALL, engine=LocalEngine(2))
    assert contents(tmp_path) == contents(small_folder)


def test_progress_grows_to_the_total(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    collect(tmp_path, SMALL, engine=LocalEngine(1), progress=lambda done, total: seen.append((done, total)))
    assert seen[0] == (0, SMALL.maps)
    assert seen[-1] == (SMALL.maps, SMALL.maps)
    assert [done for done, _ in seen] == sorted({done for done, _ in seen})
    assert len(seen) > SMALL.shards + 1


@pytest.mark.parametrize("full_from", [1, 4, 9, 12])
def test_a_full_disk_is_said_and_can_be_continued(
    tmp_path: Path, small_folder: Path, monkeypatch: pytest.MonkeyPatch, full_from: int
) -> None:
    calls = 0

    def sync(descriptor: int) -> None:
        nonlocal calls
        calls += 1
        if calls >= full_from:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", sync)
        with pytest.raises(TriformError, match=r"no space left to write .* run the same command again"):
            collect(tmp_path, SMALL, engine=LocalEngine(2))
    assert not list(tmp_path.rglob("*.tmp"))
    collect(tmp_path, SMALL, engine=LocalEngine(2))
    assert contents(tmp_path) == contents(small_folder)


def test_collecting_again_changes_nothing(tmp_path: Path) -> None:
    collect(tmp_path, SMALL, engine=LocalEngine(2))
    before = contents(tmp_path)
    times = [path.stat().st_mtime_ns for path in sorted((tmp_path / "shards").iterdir())]
    collect(tmp_path, SMALL, engine=LocalEngine(1))
    assert contents(tmp_path) == before
    assert [path.stat().st_mtime_ns for path in sorted((tmp_path / "shards").iterdir())] == times


def test_another_configuration_is_refused(tmp_path: Path) -> None:
    tiny = replace(SMALL, runs=1, placements=0)
    collect(tmp_path, tiny, engine=LocalEngine(1))
    before = contents(tmp_path)
    with pytest.raises(TriformError, match=r"another configuration \(seed 3 instead of 4\)"):
        collect(tmp_path, replace(tiny, seed=4), engine=LocalEngine(1))
    assert contents(tmp_path) == before


def test_other_versions_are_refused_where_shards_are_missing(tmp_path: Path) -> None:
    tiny = replace(SMALL, runs=3, placements=0)
    manifest = collect(tmp_path, tiny, engine=LocalEngine(1))
    replace(manifest, versions={**manifest.versions, "numba": "0.1"}).save(tmp_path)
    collect(tmp_path, tiny, engine=LocalEngine(1))
    (tmp_path / "shards" / "shard-00001.parquet").unlink()
    with pytest.raises(TriformError, match=r"cannot be continued with"):
        collect(tmp_path, tiny, engine=LocalEngine(1))


def test_a_deleted_shard_is_restored_and_a_damaged_one_refused(tmp_path: Path, small_folder: Path) -> None:
    collect(tmp_path, SMALL, engine=LocalEngine(2))
    shard = tmp_path / "shards" / "shard-00004.parquet"
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    with pytest.raises(TriformError, match=r"shard-00004\.parquet is damaged or foreign"):
        collect(tmp_path, SMALL, engine=LocalEngine(2))
    shard.unlink()
    collect(tmp_path, SMALL, engine=LocalEngine(2))
    assert contents(tmp_path) == contents(small_folder)


def test_a_folder_with_other_things_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("do not touch")
    with pytest.raises(TriformError, match="is not empty and holds no data set"):
        collect(tmp_path, SMALL, engine=LocalEngine(1))
    assert list(contents(tmp_path)) == ["thesis.tex"]


@pytest.mark.parametrize("below", ["file", "file/below"])
def test_an_unwritable_folder_is_refused(tmp_path: Path, below: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TriformError, match=r"cannot write .*file"):
        collect(tmp_path / below, SMALL, engine=LocalEngine(1))


def test_two_collections_into_one_folder_are_refused(tmp_path: Path) -> None:
    with exclusive(tmp_path), pytest.raises(TriformError, match=f"another process .id {os.getpid()}. is writing"):
        collect(tmp_path, SMALL, engine=LocalEngine(1))
