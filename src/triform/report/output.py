"""Result files: checked before hours of work, written whole or not at all."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from triform.files import exclusive, write_atomically
from triform.types import TriformError


def prepare_folder(folder: Path) -> Path:
    """Create ``folder`` and make sure that files can be written in it.

    Raises:
        TriformError: It cannot be created or written, so nothing should be computed for it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise TriformError(f"cannot write to the output folder {folder}: {reason}") from error
    return folder


@contextmanager
def own_folder(folder: Path) -> Iterator[None]:
    """Hold an output folder, which is created, for this process alone.

    Raises:
        TriformError: It cannot be created or written, or another process writes into it.
    """
    prepare_folder(folder)
    with exclusive(folder):
        yield


def prepare_file(path: Path) -> Path:
    """Make sure that the result file ``path`` can be written, creating its folder.

    Raises:
        TriformError: ``path`` is a folder or a device, or its folder cannot be created or written.
    """
    if path.is_dir():
        raise TriformError(f"cannot write the result file {path}: it is a folder, a file name is needed")
    if path.exists() and not path.is_file():
        raise TriformError(f"cannot write the result file {path}: it is a device or the like, and would be replaced")
    prepare_folder(path.parent)
    return path


def write_text(path: Path, text: str) -> Path:
    """Write ``text`` to ``path`` atomically as UTF-8, and return the path.

    Raises:
        TriformError: The file cannot be written; ``path`` is then as it was.
    """
    write_atomically(path, text.encode("utf-8"))
    return path


def write_json(path: Path, value: Any) -> Path:
    """Write ``value`` to ``path`` atomically as JSON; what is not a number becomes ``null``."""
    return write_text(path, json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """Return ``value`` in plain JSON terms: NumPy scalars and arrays unpacked, NaN and infinities ``None``."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value
