"""Compiled kernels of one state of the sources are never used for another."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import triform

PRINT = "import os, triform; print(os.environ.get('NUMBA_CACHE_DIR'))"


def cache_folder(**environment: str) -> str:
    inherited = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    command = [sys.executable, "-c", PRINT]
    return subprocess.run(
        command, env=inherited | environment, capture_output=True, text=True, check=True
    ).stdout.strip()


def test_the_folder_is_named_after_the_kernels(tmp_path: Path) -> None:
    package = tmp_path / "source" / "triform"
    shutil.copytree(Path(triform.__file__).parent, package, ignore=shutil.ignore_patterns("weights", "__pycache__"))
    settings = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "PYTHONPATH": str(package.parent)}
    before = cache_folder(**settings)
    assert Path(before).parent == tmp_path / "cache" / "triform"
    assert Path(before).is_dir()
    assert cache_folder(**settings) == before
    with (package / "control" / "expert.py").open("a") as file:
        file.write("# changed\n")
    assert cache_folder(**settings) != before


def test_a_folder_that_the_user_chose_or_cannot_have_is_left_alone(tmp_path: Path) -> None:
    assert cache_folder(NUMBA_CACHE_DIR="/somewhere") == "/somewhere"
    blocked = tmp_path / "file"
    blocked.touch()
    assert cache_folder(XDG_CACHE_HOME=str(blocked)) == "None"
