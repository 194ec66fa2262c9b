"""Compiled kernels: the decorator that makes them, and the folder that keeps them from one process to the next.

The kernels of each state of the sources, of Python and of Numba have a folder of their own, named after a digest of
these, because Numba notices when the file of a kept kernel changes, but not when a kernel that it calls from another
file does. It lies in the folder that the user chose for Numba (``NUMBA_CACHE_DIR``), else in
``$XDG_CACHE_HOME/triform`` or ``~/.cache/triform``, else in the folder of temporary files.

Kept code is machine code inside a pickle. So a folder counts only if it is the user's own and nobody else can write to
it or take its place; kept code has a checksum, which is compared before anything is unpickled. Where no folder counts,
or kept code is damaged, kernels are compiled again: what is kept decides how soon they run, and nothing else. Kernels
of other packages stay where Numba puts them.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import stat
import sys
import tempfile
import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, overload

import numba
import numpy as np
from numba import config, njit
from numba.core.caching import FunctionCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps


@overload
def kernel(function: Callable[..., Any]) -> Any: ...
@overload
def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]: ...
def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function for one thread, free of the interpreter's lock, and keep what the compiler made of it.

    Args:
        function: What to compile; without it, the decorator with the given options comes back.
        **options: More options of ``numba.njit``.
    """
    if function is None:
        return lambda given: kernel(given, **options)
    compiled = njit(function, nogil=True, **options)
    # Of functions outside the package the digest knows nothing.
    if _FOLDER is not None and not config.DISABLE_JIT and function.__module__.startswith("triform."):
        compiled._cache = _KernelCache(function)
    return compiled


def kernels_compiled() -> bool:
    """Whether the folder holds compiled kernels of these sources already."""
    return _FOLDER is not None and _holds_kernels(_FOLDER)


def kernels_were_compiled() -> bool:
    """Whether the folder held compiled kernels when this process began."""
    return _FOUND


def _digest() -> str:
    """Digest of all modules with kernels or groups of their arguments, of the constants they take, and of compilers."""
    package = Path(__file__).parent
    digest = hashlib.sha256(f"{sys.implementation.cache_tag} {numba.__version__} {np.__version__}".encode())
    for path in sorted(package.rglob("*.py")):
        source = path.read_bytes()
        if b"\n@kernel" in source or b"(NamedTuple)" in source or path in (Path(__file__), package / "types.py"):
            digest.update(path.relative_to(package).as_posix().encode() + b"\0" + source + b"\0")
    return digest.hexdigest()[:16]


def _places() -> Iterator[Path]:
    """Where compiled kernels may be kept, best first."""
    if config.CACHE_DIR:
        yield Path(config.CACHE_DIR)
    with suppress(RuntimeError):
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "triform"
    with suppress(OSError):
        yield Path(tempfile.gettempdir()) / (f"triform-{os.geteuid()}" if hasattr(os, "geteuid") else "triform")


def _find_folder() -> Path | None:
    """Return the folder of the compiled kernels; ``None`` if they can have none."""
    name = _digest()
    for place in _places():
        # A loop of links is a RuntimeError in some versions of Python.
        with suppress(OSError, RuntimeError):
            folder = place.resolve() / name
            for each in (*reversed(folder.parents), folder):
                each.mkdir(0o700, exist_ok=True)
            if _is_private(folder) and (os.access(folder, os.W_OK | os.X_OK) or _holds_kernels(folder)):
                return folder
    return None


def _is_private(folder: Path) -> bool:
    """Whether a folder is the user's own, and no other user can write to it or put another in its place."""
    if not hasattr(os, "geteuid"):
        return True
    found = folder.stat()
    if found.st_uid != os.geteuid() or found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return False
    trusted = {os.geteuid(), folder.parents[-1].stat().st_uid}
    for parent in folder.parents:
        found = parent.stat()
        others_write = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not found.st_mode & stat.S_ISVTX
        if found.st_uid not in trusted or others_write:
            return False
    return True


def _holds_kernels(folder: Path) -> bool:
    return any(folder.glob("*.kernel"))


class _KernelCache(FunctionCache):  # type: ignore[misc]
    """Numba's cache of one kernel, in our folder: a file for each signature, a checksum before the pickle."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._py_func = function
        self._cache_path = str(_FOLDER)
        self.enable()

    def load_overload(self, signature: Any, target: Any) -> Any:
        target.refresh()
        # Whatever is wrong with kept code, the kernel is compiled.
        with suppress(Exception):
            kept = self._path(signature, target.codegen()).read_bytes()
            if hashlib.sha256(kept[32:]).digest() == kept[:32]:
                return CompileResult._rebuild(target, *pickle.loads(kept[32:]))  # noqa: S301 - see the module
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        if compiled.library.has_dynamic_globals:
            return
        code = dumps(compiled._reduce())
        path = self._path(signature, compiled.library.codegen)
        temporary = path.with_name(f".{uuid.uuid4().hex}.tmp")
        with suppress(OSError):
            try:
                temporary.write_bytes(hashlib.sha256(code).digest() + code)
                temporary.replace(path)
            finally:
                temporary.unlink(missing_ok=True)

    def _path(self, signature: Any, codegen: Any) -> Path:
        key = hashlib.sha256(repr(self._index_key(signature, codegen)).encode()).hexdigest()[:16]
        name = f"{self._py_func.__module__}.{self._py_func.__qualname__}".replace("<", "").replace(">", "")
        return Path(self._cache_path) / f"{name}-{key}.kernel"


_FOLDER = _find_folder()
_FOUND = kernels_compiled()
