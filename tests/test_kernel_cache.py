"""Compiled kernels of one state of the sources are never used for another, and no other library hears of them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import triform

PRINT = "import os; before = dict(os.environ); from triform.kernels import kernel_folder; print(kernel_folder())"
PRINT += "; import triform.control; assert dict(os.environ) == before"
RUN = """
from triform.geometry import gabriel_graph
import numpy as np
print(gabriel_graph(np.zeros((1, 1, 2))).shape)
"""


def run(code: str, **environment: str) -> str:
    inherited = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, env=inherited | environment, capture_output=True, text=True, check=True
    ).stdout.strip()


def test_the_folder_is_named_after_the_kernels(tmp_path: Path) -> None:
    package = tmp_path / "source" / "triform"
    shutil.copytree(Path(triform.__file__).parent, package, ignore=shutil.ignore_patterns("weights", "__pycache__"))
    settings = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "PYTHONPATH": str(package.parent)}
    before = run(PRINT, **settings)
    assert Path(before).parent == tmp_path / "cache" / "triform"
    assert Path(before).is_dir()
    assert run(PRINT, **settings) == before
    with (package / "control" / "expert.py").open("a") as file:
        file.write("# changed\n")
    assert run(PRINT, **settings) != before


def test_a_folder_that_the_user_chose_keeps_the_kernels(tmp_path: Path) -> None:
    chosen = tmp_path / "chosen"
    assert run(PRINT, NUMBA_CACHE_DIR=str(chosen)) == "None"
    run(RUN, NUMBA_CACHE_DIR=str(chosen))
    assert any(chosen.rglob("*.nbi"))


def test_without_a_folder_kernels_are_compiled_anew(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.touch()
    assert run(PRINT, XDG_CACHE_HOME=str(blocked)) == "None"
    assert run(RUN, XDG_CACHE_HOME=str(blocked)) == "(1, 1, 1)"


def test_kernels_are_kept_and_a_user_s_own_kernels_stay_where_numba_puts_them(tmp_path: Path) -> None:
    module = tmp_path / "mine.py"
    module.write_text("import numba\n\n@numba.njit(cache=True)\ndef double(x):\n    return 2 * x\n")
    code = RUN + "\nimport mine\nmine.double(1)"
    run(code, XDG_CACHE_HOME=str(tmp_path / "cache"), PYTHONPATH=str(tmp_path))
    kept = {path.name.split("-")[0] for path in (tmp_path / "cache" / "triform").rglob("*.nbi")}
    assert kept
    assert "mine.double" not in kept
    assert any(path.name.startswith("mine.double") for path in (tmp_path / "__pycache__").glob("*.nbi"))
