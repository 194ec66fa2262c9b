"""Files that are either whole or absent, whatever happens while they are written and whoever else writes them."""

from __future__ import annotations

import errno
import glob
import hashlib
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from triform.types import TriformError

_LOCK = ".lock"


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that ``path`` is never seen half written, as ``open_atomically`` says.

    Raises:
        TriformError: If the folder cannot be written or the disk is full; ``path`` is then as it was.
    """
    with open_atomically(path) as file, _refusing(path):
        file.write(data)


@contextmanager
def open_atomically(path: Path) -> Iterator[IO[bytes]]:
    """Give a file to write, which is called ``path`` once the block ends.

    So ``path`` is never seen half written, not even after a power cut: the bytes go to a temporary name of their own
    beside it, reach the disk, and only then take their name. If the block fails, ``path`` is as it was. Of several
    processes that write one file, the last one wins. What a killed one left of it is removed.

    Raises:
        TriformError: If the folder cannot be written or the disk is full; ``path`` is then as it was.
    """
    with _refusing(path):
        _remove_leftovers(path.parent, f".{glob.escape(path.name)}.*.tmp")
        temporary, file = _open_temporary(path)
    try:
        yield file
        with _refusing(path):
            file.flush()
            os.fsync(file.fileno())
            temporary.replace(path)
            file.close()
            _sync_folder(path.parent)
    finally:
        # Closing writes what is still in the buffer, of a file that is given up.
        with suppress(OSError):
            file.close()
        with _refusing(path):
            temporary.unlink(missing_ok=True)


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Say in one sentence why ``path`` could not be written."""
    try:
        yield
    except OSError as error:
        raise cannot_write(path, error) from error


def _open_temporary(path: Path) -> tuple[Path, IO[bytes]]:
    """Create a temporary file beside ``path`` and lock it, so that it is known to have a living writer."""
    while True:
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp")
        file = temporary.open("xb")
        # On file systems without locks nothing can be known to be a leftover, and none is removed.
        with suppress(OSError):
            _lock(file)
        # Another process may have removed it as a leftover before it was locked.
        if temporary.exists():
            return temporary, file
        file.close()


def _remove_leftovers(folder: Path, pattern: str) -> None:
    """Remove temporary files without a living writer, which would hold its lock on them, as far as possible."""
    for leftover in folder.glob(pattern):
        with suppress(OSError), leftover.open("rb+") as file:
            _lock(file, wait=False)
            leftover.unlink(missing_ok=True)


def _lock(file: IO[Any], *, wait: bool = True) -> None:
    """Lock an open file until it is closed or its process ends; where Python has no such locks, do nothing.

    Raises:
        BlockingIOError: If another process holds it and shall not be waited for.
        OSError: If the file system has no locks.
    """
    try:
        import fcntl
    except ModuleNotFoundError:
        return
    fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


def _sync_folder(folder: Path) -> None:
    """Make renames inside ``folder`` survive a power cut."""
    if os.name == "nt":
        # Windows opens no folders.
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some network file systems cannot sync a folder; the file itself has reached the disk.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def cannot_write(path: Path, error: OSError) -> TriformError:
    """Say in one sentence why ``path`` could not be written."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return TriformError(
            f"no space left to write {path}; what was finished before is safe, "
            "so free some space and run the same command again to continue"
        )
    return TriformError(f"cannot write {path}: {error.strerror or error}")


def refuse_device(path: Path) -> None:
    """Refuse to read from a device, because some of them, such as ``/dev/zero``, never end.

    Raises:
        OSError: It is one, or cannot be looked at.
    """
    if path.is_char_device() or path.is_block_device():
        raise OSError(errno.ENOTSUP, "it is a device, and a file is needed", str(path))


def sha256(data: bytes) -> str:
    """SHA-256 of ``data`` in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def make_folder(path: Path) -> None:
    """Create a folder and its parents unless it exists.

    Raises:
        TriformError: If that is not possible.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from error


def remove_temporaries(folder: Path) -> None:
    """Remove what killed processes left of files that they wrote into ``folder``; those of living ones stay."""
    _remove_leftovers(folder, ".*.tmp")


@contextmanager
def exclusive(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold ``folder`` for this process alone; the system lets go of it even if the process is killed.

    Args:
        folder: What to hold; it exists.
        wait: Whether to wait for a process that holds it.

    Raises:
        TriformError: If another process holds it, or the folder cannot be written.
    """
    path = folder / _LOCK
    while True:
        try:
            file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise cannot_write(path, error) from error
        with file:
            _lock_folder(folder, file, wait=wait)
            # Whoever held it before may have removed the file meanwhile; another is then locked by others.
            if not path.exists() or not os.path.samestat(path.stat(), os.fstat(file.fileno())):
                continue
            try:
                file.truncate(0)
                file.write(f"{os.getpid()}\n")
                file.flush()
                yield
            finally:
                with suppress(OSError):
                    path.unlink()
            return


def _lock_folder(folder: Path, file: IO[str], *, wait: bool) -> None:
    """Lock the lock file of ``folder``; errors as ``exclusive``."""
    try:
        _lock(file, wait=wait)
    except BlockingIOError as error:
        file.seek(0)
        holder = file.read(20).strip()
        who = f" (id {holder})" if holder.isdecimal() else ""
        raise TriformError(f"another process{who} is writing into {folder}; wait for it or stop it") from error
    except OSError as error:
        raise TriformError(f"cannot lock {folder}: {error.strerror or error}") from error
