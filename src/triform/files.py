"""Files that are either whole or absent, whatever happens while they are written."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from triform.types import TriformError

_LOCK = ".lock"


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that ``path`` is never seen half written, not even after a power cut.

    The bytes go to a temporary name beside it, reach the disk, and only then take their name.

    Raises:
        TriformError: If the folder cannot be written or the disk is full; ``path`` is then as it was.
    """
    write_together(path.parent, {path.name: data})


def write_together(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files that belong together: none takes its name before the bytes of all have reached the disk.

    Args:
        folder: Where to; it exists.
        files: Content by name.

    Raises:
        TriformError: If the folder cannot be written or the disk is full; the files are then as they were.
    """
    path, staged = folder, []
    try:
        for name, data in files.items():
            path = folder / name
            staged.append((path.with_name(f".{name}.tmp"), path))
            with staged[-1][0].open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        for temporary, path in staged:
            temporary.replace(path)
        _sync_folder(folder)
    except OSError as error:
        for temporary, _ in staged:
            temporary.unlink(missing_ok=True)
        raise cannot_write(path, error) from error


def _sync_folder(folder: Path) -> None:
    """Make renames inside ``folder`` survive a power cut."""
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
    """Remove what a killed ``write_atomically`` left in ``folder``.

    Raises:
        TriformError: If the folder cannot be written.
    """
    for leftover in folder.glob(".*.tmp"):
        try:
            leftover.unlink(missing_ok=True)
        except OSError as error:
            raise cannot_write(leftover, error) from error


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Hold ``folder`` for this process alone; the system lets go of it even if the process is killed.

    Raises:
        TriformError: If another process holds it, or the folder cannot be written.
    """
    path = folder / _LOCK
    try:
        file = path.open("wb")
    except OSError as error:
        raise cannot_write(path, error) from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise TriformError(f"another process is writing into {folder}; wait for it or stop it") from error
        except OSError as error:
            raise TriformError(f"cannot lock {folder}: {error.strerror or error}") from error
        yield
