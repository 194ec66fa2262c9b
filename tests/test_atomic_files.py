from __future__ import annotations

import ast
import errno
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import triform
from triform import files
from triform.types import TriformError

#: Modules that Python has on some systems only.
ON_SOME_SYSTEMS = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
#: Writes, locks and reads where Python has nothing of what POSIX adds, as on Windows; libraries are imported before.
WITHOUT_POSIX = """
import os, signal, sys
import numba, numpy, onnxruntime, rich.console, tyro
for name in sys.argv[2].split():
    sys.modules[name] = None
del signal.SIGHUP, os.sched_getaffinity, os.fork, os.openpty, os.geteuid
from pathlib import Path
import triform.cli, triform.commands.collect, triform.robots.drive, triform.timing.robot
from triform.files import exclusive, write_atomically
from triform.signals import StopSignals
for name in triform.__all__:
    getattr(triform, name)
folder = Path(sys.argv[1])
with exclusive(folder), StopSignals():
    write_atomically(folder / "file", b"content")
print(*(path.name for path in folder.iterdir()))
"""


@pytest.mark.parametrize("code", [errno.EINVAL, errno.ENOTSUP])
def test_a_folder_that_cannot_be_synced_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    sync = os.fsync

    def refuse_folders(descriptor: int) -> None:
        if os.path.isdir(f"/proc/self/fd/{descriptor}"):  # noqa: PTH112 - a link of the system's
            raise OSError(code, "refused")
        sync(descriptor)

    monkeypatch.setattr(files.os, "fsync", refuse_folders)
    files.write_atomically(tmp_path / "file", b"content")
    assert (tmp_path / "file").read_bytes() == b"content"


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_a_disk_that_fails_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    path = tmp_path / "file"
    files.write_atomically(path, b"before")

    def fail(_: int) -> None:
        raise OSError(code, "failed")

    monkeypatch.setattr(files.os, "fsync", fail)
    with pytest.raises(TriformError, match="file"):
        files.write_atomically(path, b"after")
    assert path.read_bytes() == b"before"
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_a_lock_that_the_system_refuses_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", refuse)
    with pytest.raises(TriformError, match="No locks available"), files.exclusive(tmp_path):
        pass


def test_what_a_killed_writer_left_is_removed_and_what_a_living_one_writes_is_not(tmp_path: Path) -> None:
    path, other = tmp_path / "file[1]", tmp_path / "other"
    killed, others = tmp_path / ".file[1].0123.tmp", tmp_path / ".other.0123.tmp"
    killed.write_bytes(b"half")
    others.write_bytes(b"half")
    temporary, writer = files._open_temporary(path)
    files.write_atomically(path, b"content")
    assert sorted(tmp_path.iterdir()) == sorted([path, temporary, others])
    files.remove_temporaries(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([path, temporary])
    writer.close()
    files.write_atomically(other, b"content")
    assert temporary.exists()
    files.write_atomically(path, b"content")
    assert sorted(tmp_path.iterdir()) == sorted([path, other])


def test_a_writer_whose_file_was_taken_for_a_leftover_begins_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, removed = files._lock, []

    def late(file: object, *, wait: bool = True) -> None:
        if not removed:
            removed.extend(tmp_path.glob(".*"))
            removed[0].unlink()
        lock(file, wait=wait)  # type: ignore[arg-type]

    monkeypatch.setattr(files, "_lock", late)
    files.write_atomically(tmp_path / "file", b"content")
    assert removed
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_a_file_system_without_locks_still_takes_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", refuse)
    (tmp_path / ".file.0123.tmp").write_bytes(b"of whom?")
    files.write_atomically(tmp_path / "file", b"content")
    assert {each.name for each in tmp_path.iterdir()} == {"file", ".file.0123.tmp"}


def test_a_folder_that_is_held_says_who_holds_it_and_is_let_go(tmp_path: Path) -> None:
    with files.exclusive(tmp_path):
        with pytest.raises(TriformError, match=f"another process .id {os.getpid()}. is writing into"):
            files.exclusive(tmp_path).__enter__()
        (tmp_path / ".lock").write_text("who?")
        with pytest.raises(TriformError, match="another process is writing into"):
            files.exclusive(tmp_path).__enter__()
    assert list(tmp_path.iterdir()) == []
    # What a killed process left locks no folder.
    (tmp_path / ".lock").write_text("1\n")
    with files.exclusive(tmp_path):
        pass


def test_those_who_wait_for_a_folder_hold_it_one_after_the_other(tmp_path: Path) -> None:
    holding, most = 0, 0

    def hold() -> None:
        nonlocal holding, most
        for _ in range(20):
            with files.exclusive(tmp_path, wait=True):
                holding += 1
                most = max(most, holding)
                time.sleep(0.0005)
                holding -= 1

    threads = [threading.Thread(target=hold) for _ in range(3)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert most == 1


def test_files_are_written_and_held_where_python_has_nothing_of_posix(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WITHOUT_POSIX, str(tmp_path), " ".join(ON_SOME_SYSTEMS - {"posix"})]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.stdout.split(), done.stderr) == (["file"], "")


def test_nothing_is_imported_at_once_that_some_systems_lack() -> None:
    for path in Path(triform.__file__).parent.rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.split(".")[0] for name in names} & ON_SOME_SYSTEMS, path
