"""What a folder of compiled kernels holds, or whether there is one, decides how soon they run and nothing else."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from numba import config

import triform
from tests.fuzz import kept_kernels
from triform import kernels

#: Runs a kernel that calls one of another file; says whether the package had kernels at the start, where this one is
#: kept, and whether it came from there.
RUN = """
from triform.kernels import kernels_compiled
print(kernels_compiled())
from triform.simulation.moving_ray_kernels import seen_within
from triform.simulation.ray_kernels import ScanRays
from triform.types import Body
assert abs(seen_within(Body(0.3, 0.4, False), ScanRays(0.0, 0.1, 2.0, (), ()), 0.25) - 3.0) < 1e-8
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


def run(script: str | Path, *before: str, **environment: str) -> list[str]:
    inherited = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    command = [*before, sys.executable, *(["-c", script] if isinstance(script, str) else [str(script)])]
    done = subprocess.run(command, env=inherited | environment, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.split()


def in_folder(home: Path) -> dict[str, str]:
    return {"XDG_CACHE_HOME": str(home)}


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package, to change its sources."""
    copy = tmp_path_factory.mktemp("source") / "triform"
    shutil.copytree(Path(triform.__file__).parent, copy, ignore=shutil.ignore_patterns("weights", "__pycache__"))
    return copy


@pytest.fixture
def places(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., list[Path]]:
    """Sets where kernels may be kept: the user's choice for Numba, the home folder's, the temporary one."""

    def choose(chosen: Path, home: Path, temporary: Path) -> list[Path]:
        monkeypatch.setattr(config, "CACHE_DIR", str(chosen))
        monkeypatch.setenv("XDG_CACHE_HOME", str(home))
        monkeypatch.setattr(tempfile, "tempdir", str(temporary))
        return [chosen, home / "triform", temporary / f"triform-{os.geteuid()}"]

    return choose


def test_kernels_are_found_again_until_the_sources_change(package: Path, tmp_path: Path) -> None:
    settings = in_folder(tmp_path) | {"PYTHONPATH": str(package.parent)}
    compiled, folder, hits = run(RUN, **settings)
    assert (compiled, hits) == ("False", "0")
    assert Path(folder).parent == tmp_path / "triform"
    assert list(Path(folder).glob("*.kernel"))
    assert stat.S_IMODE(Path(folder).stat().st_mode) == 0o700
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
    assert not (tmp_path / "home").exists()


def test_a_folder_that_cannot_be_made_is_passed_over(tmp_path: Path) -> None:
    # Not even root makes folders there.
    nowhere = {"NUMBA_CACHE_DIR": "/proc/chosen", "XDG_CACHE_HOME": "/proc/home", "TMPDIR": str(tmp_path)}
    _, folder, hits = run(RUN, **nowhere)
    assert Path(folder).parent == tmp_path / f"triform-{os.geteuid()}"
    assert hits == "0"
    assert run(RUN, **nowhere) == ["True", folder, "1"]


def test_a_full_disk_costs_nothing_but_the_kept_kernels(tmp_path: Path) -> None:
    _, folder, hits = run(RUN, "sh", "-c", 'ulimit -f 0; exec "$@"', "sh", **in_folder(tmp_path))
    assert hits == "0"
    assert list(Path(folder).iterdir()) == []


def test_a_home_without_a_folder_is_no_error(places: Callable[..., list[Path]], tmp_path: Path) -> None:
    def homeless() -> Path:
        raise RuntimeError("could not determine home directory")

    places(Path("/proc/chosen"), Path(), tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("XDG_CACHE_HOME")
        patch.setattr(Path, "home", homeless)
        found = kernels._find_folder()
    assert found is not None
    assert found.parent.parent == tmp_path


def a_file(place: Path) -> None:
    place.parent.mkdir(exist_ok=True)
    place.write_text("not a folder")


def open_to_all(place: Path) -> None:
    place.mkdir(parents=True)
    place.chmod(0o777)


def open_to_the_group(place: Path) -> None:
    place.mkdir(parents=True)
    place.chmod(0o770)


def below_an_open_one(place: Path) -> None:
    place.mkdir(parents=True)
    place.parent.chmod(0o777)


def full_of_others(place: Path) -> None:
    folder = place / kernels._digest()
    folder.mkdir(parents=True)
    folder.chmod(0o777)


def somebody_elses(place: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root gives folders away")
    folder = place / kernels._digest()
    folder.mkdir(parents=True, mode=0o700)
    os.chown(folder, 12345, 12345)


def below_somebody_elses(place: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root gives folders away")
    place.mkdir(parents=True, mode=0o755)
    os.chown(place.parent, 12345, 12345)


def link_to_nowhere(place: Path) -> None:
    place.parent.mkdir(exist_ok=True)
    place.symlink_to("/proc/nowhere")


def loop_of_links(place: Path) -> None:
    place.parent.mkdir(exist_ok=True)
    place.symlink_to(place)


UNUSABLE = [
    a_file, open_to_all, open_to_the_group, below_an_open_one, full_of_others, somebody_elses, below_somebody_elses,
    link_to_nowhere, loop_of_links,
]  # fmt: skip


@pytest.mark.parametrize("spoil", UNUSABLE)
def test_a_folder_that_is_not_the_users_alone_is_not_used(
    spoil: Callable[[Path], None], places: Callable[..., list[Path]], tmp_path: Path
) -> None:
    chosen, home, temporary = places(*(tmp_path / name / "place" for name in ("chosen", "home", "temporary")))
    spoil(chosen)
    found = kernels._find_folder()
    assert found is not None
    assert found.parent == home
    shutil.rmtree(home)
    spoil(home)
    temporary.parent.mkdir(parents=True)
    found = kernels._find_folder()
    assert found is not None
    assert found.parent == temporary
    shutil.rmtree(temporary)
    spoil(temporary)
    assert kernels._find_folder() is None


def test_a_folder_below_a_sticky_one_is_used(places: Callable[..., list[Path]], tmp_path: Path) -> None:
    chosen = places(*(tmp_path / name for name in ("chosen", "home", "temporary")))[0]
    tmp_path.chmod(0o1777)
    assert kernels._find_folder() == chosen / kernels._digest()


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> kept_kernels.KeptKernel:
    monkeypatch.setattr(kernels, "_FOLDER", tmp_path)
    return kept_kernels.KeptKernel(tmp_path)


def test_without_a_folder_kernels_are_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "_FOLDER", None)
    assert kept_kernels.fresh()(20, 1) == 41
    assert not kernels.kernels_compiled()


@pytest.mark.parametrize("damage", [b"", b"\0", bytes(100), b"\x80\x04."], ids=["empty", "short", "zeros", "pickle"])
def test_damaged_code_is_compiled_and_kept_again(kept: kept_kernels.KeptKernel, damage: bytes) -> None:
    kept.path.write_bytes(damage)
    again = kept_kernels.fresh()
    assert again(20, 1) == 41
    assert sum(again.stats.cache_misses.values()) == 1
    once_more = kept_kernels.fresh()
    assert once_more(20, 1) == 41
    assert sum(once_more.stats.cache_hits.values()) == 1
    third = kept_kernels.fresh()
    assert third(20, 1) == 41
    assert sum(third.stats.cache_hits.values()) == 1


def test_a_folder_in_the_place_of_a_kernel_is_left_alone(kept: kept_kernels.KeptKernel) -> None:
    kept.path.unlink()
    kept.path.mkdir()
    assert kept_kernels.fresh()(20, 1) == 41
    assert kept.path.is_dir()
    assert list(kept.path.parent.iterdir()) == [kept.path]


def test_no_mutation_of_kept_code_is_loaded(kept: kept_kernels.KeptKernel) -> None:
    assert kept_kernels.campaign(kept, tries=300, seed=1) == (300, [])


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
