"""Compiled kernels of one state of the sources are never used for another, and other users of Numba keep theirs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import triform

#: Runs a kernel that calls one of another file, and says where it is kept, whether it came from there, and whether the
#: kernels of the package were there at the start.
RUN = """
from triform.kernels import kernels_compiled
print(kernels_compiled())
from triform.simulation.moving_ray_kernels import seen_within
from triform.simulation.ray_kernels import ScanRays
from triform.types import Body
seen_within(Body(0.2, 0.1, False), ScanRays(0.0, 0.1, 2.0, (), ()), 0.0)
print(seen_within.stats.cache_path)
print(sum(seen_within.stats.cache_hits.values()))
"""
#: The function of somebody who also uses Numba.
FOREIGN = """
from numba import njit
{first}
@njit(cache=True)
def double(x):
    return 2 * x
double(1)
print(double.stats.cache_path)
"""


def run(script: str | Path, **environment: str) -> list[str]:
    inherited = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    command = [sys.executable, *(["-c", script] if isinstance(script, str) else [str(script)])]
    done = subprocess.run(command, env=inherited | environment, capture_output=True, text=True, check=True)
    return done.stdout.split()


def in_folder(home: Path) -> dict[str, str]:
    return {"XDG_CACHE_HOME": str(home)}


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package, to change its sources."""
    copy = tmp_path_factory.mktemp("source") / "triform"
    shutil.copytree(Path(triform.__file__).parent, copy, ignore=shutil.ignore_patterns("weights", "__pycache__"))
    return copy


def test_kernels_are_found_again_until_the_sources_change(package: Path, tmp_path: Path) -> None:
    settings = in_folder(tmp_path) | {"PYTHONPATH": str(package.parent)}
    compiled, folder, hits = run(RUN, **settings)
    assert (compiled, hits) == ("False", "0")
    assert Path(folder).parents[1] == tmp_path / "triform"
    assert list(Path(folder).glob("*.nbi"))
    assert run(RUN, **settings) == ["True", folder, "1"]
    # A file that the kernel calls, not its own.
    with (package / "simulation" / "ray_kernels.py").open("a") as file:
        file.write("# changed\n")
    compiled, other, hits = run(RUN, **settings)
    assert (compiled, hits) == ("False", "0")
    assert other != folder


def test_the_folder_that_the_user_chose_for_numba_is_used(tmp_path: Path) -> None:
    chosen = {"NUMBA_CACHE_DIR": str(tmp_path / "chosen")}
    compiled, folder, _ = run(RUN, **in_folder(tmp_path / "home"), **chosen)
    assert compiled == "False"
    assert Path(folder).parent == tmp_path / "chosen"
    assert not (tmp_path / "home" / "triform").exists() or not list((tmp_path / "home").rglob("*.nbi"))
    assert run(RUN, **chosen) == ["True", folder, "1"]


def test_kernels_run_where_no_folder_can_be_made(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.touch()
    assert run(RUN, **in_folder(blocked)) == ["False", "None", "0"]


def test_a_full_disk_costs_nothing_but_the_kept_kernels(tmp_path: Path) -> None:
    full = "import triform.kernels, pathlib\ntriform.kernels._FOLDER = pathlib.Path('/dev/full')\n"
    assert run(full + RUN, **in_folder(tmp_path)) == ["False", "/dev/full/simulation", "0"]


def test_others_do_not_notice(tmp_path: Path) -> None:
    same = "import os; before = dict(os.environ); import triform.simulation; print(before == dict(os.environ))"
    assert run(same, **in_folder(tmp_path)) == ["True"]
    places = []
    for first in ("", "import triform.simulation"):
        script = tmp_path / "script.py"
        script.write_text(FOREIGN.format(first=first))
        places += run(script, **in_folder(tmp_path))
    assert places[0] == places[1]
    assert "triform" not in Path(places[0]).relative_to(tmp_path).parts
