"""Compiled kernels: one decorator, and the folder that keeps what it compiles.

Numba notices when the file of a kept kernel changes, but not when a kernel that it calls from another file does; an
update could then run old code. A folder named after the sources of all kernels rules that out. A folder that the user
chose (``NUMBA_CACHE_DIR``) is respected, and where none can be written kernels are compiled anew by every process.
"""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from numba import njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserWideCacheLocator


@functools.cache
def kernel_folder() -> Path | None:
    """Return the folder of compiled kernels; ``None`` if it cannot be written or the user chose one."""
    if "NUMBA_CACHE_DIR" in os.environ:
        return None
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        source = path.read_bytes()
        if b"@kernel" in source:
            digest.update(path.name.encode() + source)
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "triform" / digest.hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return None
    return folder if os.access(folder, os.W_OK) else None


def are_kernels_kept() -> bool:
    """Return whether compiled kernels are kept already, as far as it is known."""
    folder = kernel_folder()
    # Numba makes folders as soon as kernels are imported, and an index with the first one that it compiles.
    return folder is None or any(folder.rglob("*.nbi"))


class _Locator(UserWideCacheLocator):  # type: ignore[misc]
    """Keeps kernels in the folder of this package."""

    def __init__(self, py_func: Callable[..., Any], py_file: str) -> None:
        super().__init__(py_func, py_file)
        self._cache_path = str(kernel_folder() / self.get_suitable_cache_subpath(py_file))


class _Impl(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = [_Locator]  # noqa: RUF012


class _Cache(FunctionCache):  # type: ignore[misc]
    _impl_class = _Impl


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function on its first call, without the interpreter's lock, and keep what was compiled.

    Args:
        function: The function, for ``@kernel`` without options.
        **options: Options of ``numba.njit``, for ``@kernel(...)``.
    """
    if function is None:
        return functools.partial(kernel, **options)
    dispatcher = njit(nogil=True, **options)(function)
    # A cache that cannot be written must not decide whether the program runs.
    with suppress(RuntimeError, OSError):
        if kernel_folder() is not None:
            dispatcher._cache = _Cache(function)
        elif "NUMBA_CACHE_DIR" in os.environ:
            dispatcher.enable_caching()
    return dispatcher
