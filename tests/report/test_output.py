from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest

from triform.report.output import plain, prepare_file, prepare_folder, write_json, write_text
from triform.types import TriformError


def test_json_has_null_for_what_is_no_number(tmp_path):
    value = {"a": np.float64(np.nan), "b": [np.int64(3), np.inf], "c": np.array([True]), 5: Path("x"), "d": (1.5,)}
    path = write_json(tmp_path / "out.json", value)
    assert json.loads(path.read_text()) == {"a": None, "b": [3, None], "c": [True], "5": "x", "d": [1.5]}
    assert plain(None) is None


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = write_text(tmp_path / "out.txt", "old")

    def full(descriptor):
        raise OSError(errno.EIO, "disk on fire")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(TriformError, match="disk on fire"):
        write_text(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_folder_is_created_and_left_empty(tmp_path):
    folder = prepare_folder(tmp_path / "a" / "b")
    assert list(folder.iterdir()) == []


def test_bad_places_are_named_in_one_sentence(tmp_path):
    file = tmp_path / "file"
    file.touch()
    for attempt in (
        lambda: prepare_folder(file),
        lambda: prepare_folder(file / "sub"),
        lambda: prepare_file(file / "out.json"),
        lambda: prepare_file(tmp_path),
        lambda: write_text(tmp_path / "missing" / "out.txt", ""),
        lambda: prepare_folder(Path("/proc/triform")),
    ):
        with pytest.raises(TriformError, match=r"^cannot write [^\n]+$"):
            attempt()
