from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from triform.simulators.gazebo import GazeboError, Installation, find_gazebo
from triform.simulators.gazebo.install import install, main
from triform.simulators.gazebo.installation import version
from triform.types import TriformError


@pytest.fixture
def tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only folder with programs: those every machine has."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("awk", "cksum", "cut", "cat", "dirname", "df", "grep", "mkdir", "rm", "tail", "tar"):
        found = shutil.which(name)
        assert found is not None
        (folder / name).symlink_to(found)
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setenv("TRIFORM_GAZEBO", str(tmp_path / "gazebo"))
    return folder


def add(tools: Path, name: str, script: str) -> None:
    (tools / name).write_text(f"#!/bin/sh\n{script}\n")
    (tools / name).chmod(0o755)


def add_gazebo(tools: Path) -> None:
    """Let it look as if Gazebo 11 were installed with its headers."""
    add(tools, "gzserver", "exit 1")
    add(tools, "pkg-config", "echo 11.10.2")


def left(tools: Path) -> list[str]:
    return sorted(path.name for path in (tools.parent / "gazebo").iterdir())


def test_without_gazebo_and_without_packages(tools: Path, capfd: pytest.CaptureFixture[str]) -> None:
    add(tools, "id", "echo 0")
    assert main() == 1
    assert capfd.readouterr().err == (
        "triform: Gazebo could not be made ready: "
        "there is no Gazebo 11 with headers here, and no apt-get to fetch a private one\n"
    )
    assert left(tools) == []
    assert find_gazebo() is None


def test_without_root_and_without_user_namespaces(tools: Path) -> None:
    add(tools, "id", "echo 1000")
    add(tools, "unshare", "exit 1")
    with pytest.raises(GazeboError, match="needs root or user namespaces"):
        install()


def test_a_compiler_that_fails_gives_its_reason(tools: Path) -> None:
    add_gazebo(tools)
    add(tools, "g++", "echo 'lockstep.cc:6: error: no such header' >&2; echo 'compilation terminated.' >&2; exit 1")
    with pytest.raises(GazeboError, match=r"building the plugin for the Gazebo 11\.10\.2 .*error: no such header$"):
        install()
    assert left(tools) == []


def test_a_gazebo_that_does_not_run_is_not_kept(tools: Path, gazebo: Installation) -> None:
    add_gazebo(tools)
    add(tools, "g++", 'while [ "$1" != -o ]; do shift; done; : >"$2"')
    with pytest.raises(GazeboError, match="Gazebo ended with status 1"):
        install()
    assert left(tools) == []


def test_only_what_was_made_here_is_replaced(tools: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder may be any folder of the user's, such as the home folder."""
    folder = tools.parent / "gazebo"
    for name in ("0123456789abcdef", "0123456789abcdef.building", "downloads-42", "thesis", "building", "0123"):
        (folder / name / "inside").mkdir(parents=True)
    add_gazebo(tools)
    add(tools, "g++", 'while [ "$1" != -o ]; do shift; done; : >"$2"')
    monkeypatch.setattr("triform.simulators.gazebo.install._check", lambda built: None)
    assert install().plugin == folder / version() / "liblockstep.so"
    assert left(tools) == sorted(["0123", "building", "thesis", version()])


def test_what_is_ready_is_left_alone_and_an_unwritable_folder_is_one_sentence(
    tools: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready = tools.parent / "gazebo" / version()
    (ready / "root").mkdir(parents=True)
    (ready / "liblockstep.so").touch()
    assert install() == Installation(ready / "liblockstep.so", ready / "root")
    monkeypatch.setenv("TRIFORM_GAZEBO", "/proc/nowhere")
    with pytest.raises(TriformError, match="cannot write /proc/nowhere"):
        install()
