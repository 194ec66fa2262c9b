"""Compiled kernels: the decorator that makes them, and the folder that keeps them from one process to the next.

Numba notices when the file of a kept kernel changes, but not when a kernel that it calls from another file does; an
update could then run old code. So the kernels of each state of the sources have a folder of their own, below
``$XDG_CACHE_HOME/triform`` or ``~/.cache/triform``, named after a digest of these sources. A folder that the user
chose for Numba (``NUMBA_CACHE_DIR``) takes its place, and kernels that find no folder live in their process alone.
Kernels of other packages stay where Numba puts them.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, overload

from numba import config, njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator


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
    if config.CACHE_DIR or config.DISABLE_JIT or _FOLDER is None:
        return njit(function, nogil=True, cache=bool(config.CACHE_DIR), **options)
    compiled = njit(function, nogil=True, **options)
    compiled._cache = _KernelCache(function)
    return compiled


def kernels_compiled() -> bool:
    """Whether the folder holds compiled kernels of these sources already."""
    folder = Path(config.CACHE_DIR) if config.CACHE_DIR else _FOLDER
    # Numba writes an index beside the first code that it keeps of a kernel.
    return folder is not None and any(folder.rglob("*.nbi"))


def kernels_were_compiled() -> bool:
    """Whether the folder held compiled kernels when this process began."""
    return _FOUND


def _digest() -> str:
    """Digest of all modules with kernels or groups of their arguments, and of those whose constants they take."""
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        source = path.read_bytes()
        if b"\n@kernel" in source or b"(NamedTuple)" in source or path in (Path(__file__), package / "types.py"):
            digest.update(path.relative_to(package).as_posix().encode() + b"\0" + source + b"\0")
    return digest.hexdigest()[:16]


def _make_folder() -> Path | None:
    """Make the folder of the compiled kernels; ``None`` if they can have none."""
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "triform" / _digest()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None


_FOLDER = _make_folder()


class _Locator(_CacheLocator):  # type: ignore[misc]
    """Numba's question where a kernel is kept, answered: in a folder for each room, below ``_FOLDER``."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        assert _FOLDER is not None
        self._file = Path(file)
        self._path = str(_FOLDER / self._file.parent.name)
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _Locator:
        return cls(function, file)

    def get_cache_path(self) -> str:
        return self._path

    def get_source_stamp(self) -> str:
        return hashlib.sha256(self._file.read_bytes()).hexdigest()

    def get_disambiguator(self) -> str:
        return str(self._line)


class _CacheImpl(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = (_Locator,)


class _KernelCache(FunctionCache):  # type: ignore[misc]
    """Numba's cache of one kernel, in our folder; a full or broken disk costs the kept code, not the work."""

    _impl_class = _CacheImpl

    def load_overload(self, signature: Any, target: Any) -> Any:
        with suppress(OSError):
            return super().load_overload(signature, target)
        return None

    def save_overload(self, signature: Any, data: Any) -> None:
        with suppress(OSError):
            super().save_overload(signature, data)


_FOUND = kernels_compiled()
