"""Damaged and foreign data sets are named and refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.dataset import Demonstrations, collect, load_manifest
from triform.decode import checksum
from triform.engines import LocalEngine
from triform.types import TriformError

from .conftest import SMALL

NAME = "shard-00003.parquet"


@pytest.fixture
def folder(tmp_path: Path, small_folder: Path) -> Path:
    """A copy of the small data set, to be damaged."""
    return Path(shutil.copytree(small_folder, tmp_path / "copy"))


@pytest.mark.parametrize("keep", [0, 3, 1000, -1])
def test_a_truncated_shard_is_named_on_opening(folder: Path, keep: int) -> None:
    path = folder / "shards" / NAME
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(TriformError, match=rf"{NAME} is truncated"):
        Demonstrations.open(folder)


def test_a_shard_with_something_appended_is_named_on_opening(folder: Path) -> None:
    with (folder / "shards" / NAME).open("ab") as file:
        file.write(b"x")
    with pytest.raises(TriformError, match=rf"{NAME} is too long"):
        Demonstrations.open(folder)


def test_a_missing_shard_is_named_on_opening(folder: Path) -> None:
    (folder / "shards" / NAME).unlink()
    with pytest.raises(TriformError, match=rf"{NAME} is missing"):
        Demonstrations.open(folder)


def test_an_additional_shard_is_named_on_opening(folder: Path) -> None:
    shutil.copy(folder / "shards" / NAME, folder / "shards" / "mine.parquet")
    with pytest.raises(TriformError, match=r"mine\.parquet is no shard of this data set"):
        Demonstrations.open(folder)


@settings(deadline=None, max_examples=20)
@given(share=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_any_flipped_bit_is_found(small_folder: Path, tmp_path_factory: Any, share: float, bit: int) -> None:
    folder = Path(shutil.copytree(small_folder, tmp_path_factory.mktemp("flip") / "copy"))
    path = folder / "shards" / NAME
    data = bytearray(path.read_bytes())
    data[int(share * len(data))] ^= 1 << bit
    path.write_bytes(data)
    demonstrations = Demonstrations.open(folder)
    with pytest.raises(TriformError, match=rf"{NAME} is damaged or foreign"):
        demonstrations.verify()
    with pytest.raises(TriformError, match=rf"{NAME} is damaged or foreign"):
        for _ in demonstrations.batches("train", 16, pool_records=100):
            pass


def test_a_shard_of_another_data_set_is_named(folder: Path, tmp_path: Path) -> None:
    other = replace(SMALL, seed=SMALL.seed + 1)
    collect(tmp_path / "other", other, engine=LocalEngine(1))
    data = (tmp_path / "other" / "shards" / NAME).read_bytes()
    (folder / "shards" / NAME).write_bytes(data)
    with pytest.raises(TriformError, match=rf"{NAME} is (truncated|too long|damaged or foreign)"):
        Demonstrations.open(folder).verify()


def test_a_whole_data_set_verifies(small: Demonstrations) -> None:
    small.verify()


def test_a_folder_without_a_manifest_is_no_data_set(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(TriformError, match=r"is no data set: it holds no manifest\.json"):
            Demonstrations.open(path)


def test_an_unfinished_data_set_is_refused(folder: Path) -> None:
    manifest = Demonstrations.open(folder).manifest
    replace(manifest, shards=manifest.shards[:-1]).save(folder)
    with pytest.raises(TriformError, match=r"is not complete: \d+ of \d+ shards are collected"):
        Demonstrations.open(folder)


@pytest.mark.parametrize("text", ["", "{", "\x00\x01", '{"format": "triform-demonst', 100_000 * "["])
def test_a_broken_manifest_is_refused(folder: Path, text: str) -> None:
    (folder / "manifest.json").write_text(text)
    with pytest.raises(TriformError, match=r"manifest\.json cannot be read"):
        Demonstrations.open(folder)


@pytest.mark.parametrize("value", [[], 1, {}, {"format": "something else"}])
def test_a_foreign_manifest_is_refused(folder: Path, value: object) -> None:
    (folder / "manifest.json").write_text(json.dumps(value))
    with pytest.raises(TriformError, match=r"is not the manifest of a data set"):
        Demonstrations.open(folder)


def write_manifest(path: Path, values: dict[str, Any], version: object) -> None:
    """Write a manifest as a version of triform did, with the checksum of what it says if it had one."""
    rest = {key: value for key, value in values.items() if key not in ("format", "format_version", "sha256")}
    signed = {} if version == 1 else {"sha256": checksum(rest)}
    path.write_text(json.dumps({"format": values["format"], "format_version": version, **signed, **rest}))


def _set(*keys: Any, value: object) -> Callable[[Any], None]:
    def change(values: Any) -> None:
        for key in keys[:-1]:
            values = values[key]
        values[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("configuration", "robots", value=-1), "is damaged: robots is -1"),
        (_set("configuration", "runs", value=8), "is damaged"),
        (_set("configuration", value=None), "is damaged"),
        (_set("configuration", "scan", "rays", value="all"), "is damaged"),
        (_set("counts", "maps", value=1), "contradict"),
        (_set("complete", value=False), "contradict"),
        (_set("shards", 0, "index", value=1), "is damaged: it lists the shards"),
        (_set("shards", 0, "file", value="../../elsewhere"), "contradict"),
        (_set("shards", 0, value={}), "is damaged"),
        (_set("shards", value=7), "is damaged"),
        (_set("validation_runs", value=[999]), "is damaged"),
        (_set("versions", value=3), "is damaged"),
        (_set("shards", 0, "bytes", value="x"), "shard"),
        (_set("shards", 0, "bytes", value=True), "shard"),
        (_set("shards", 0, "bytes", value=-1), "shard"),
        (_set("configuration", "steps", value=10**18), "row groups"),
        (_set("configuration", "runs", value=10**18), "is damaged"),
        (_set("configuration", "robots", value=10**9), "10000 can be stored"),
        (_set("configuration", "map", "size", value=10**9), "4096"),
        (_set("configuration", "distance", value=True), "distance is True; a number is needed"),
        (_set("configuration", "footprint", "shape", value="cone"), "box or circle"),
    ],
)
def test_a_tampered_manifest_is_refused(folder: Path, change: Callable[[Any], None], message: str) -> None:
    path = folder / "manifest.json"
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))
    with pytest.raises(TriformError, match="its checksum differs"):
        Demonstrations.open(folder)
    for version in (1, 2):
        write_manifest(path, values, version)
        with pytest.raises(TriformError, match=message):
            Demonstrations.open(folder)


def test_manifests_of_earlier_versions_are_read(folder: Path) -> None:
    path = folder / "manifest.json"
    before = load_manifest(folder)
    values = json.loads(path.read_text())
    write_manifest(path, values, 1)
    assert load_manifest(folder) == before
    for version in (0, 3, "2", True, None):
        write_manifest(path, values, version)
        with pytest.raises(TriformError, match=f"has format version {version!r}"):
            Demonstrations.open(folder)
