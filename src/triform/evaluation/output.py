"""Result files: checked before hours of work, written whole or not at all."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from triform.types import TriformError


def prepare_folder(folder: Path) -> Path:
    """Create ``folder`` and make sure that files can be written in it.

    Raises:
        TriformError: It cannot be created or written, so nothing should be computed for it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _temporary(folder / "probe") as temporary:
            temporary.touch()
    except OSError as error:
        raise TriformError(f"cannot write to the output folder {folder}: {_reason(error)}") from error
    return folder


def prepare_file(path: Path) -> Path:
    """Make sure that the result file ``path`` can be written, creating its folder.

    Raises:
        TriformError: ``path`` is a folder, or its folder cannot be created or written.
    """
    if path.is_dir():
        raise TriformError(f"cannot write the result file {path}: it is a folder, a file name is needed")
    prepare_folder(path.parent)
    return path


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Offer a temporary file beside ``path`` that takes its name if the block succeeds and vanishes if not.

    Raises:
        TriformError: The file cannot be written.
    """
    try:
        with _temporary(path) as temporary:
            yield temporary
            temporary.replace(path)
    except OSError as error:
        raise TriformError(f"cannot write {path}: {_reason(error)}") from error


def write_text(path: Path, text: str) -> Path:
    """Write ``text`` to ``path`` atomically, in UTF-8."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
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


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    # The suffix is kept because writers of images choose their format by it.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
