"""Teams of robots that form a triangulation, each seeing only its own 2-D LiDAR."""

import hashlib
import os
from importlib.metadata import version
from pathlib import Path

__version__ = version("triform")


def _keep_compiled_kernels_apart() -> None:
    """Let Numba keep the compiled kernels of each state of the sources in a folder of its own.

    Numba notices when the file of a cached kernel changes, but not when a kernel that it calls from another file
    does; an update could then run old code. A folder named after all kernels' sources rules that out. A folder
    that the user chose (``NUMBA_CACHE_DIR``) is left alone, and where none can be made Numba keeps its default.
    """
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        source = path.read_bytes()
        if b"@njit" in source:
            digest.update(path.name.encode() + source)
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "triform" / digest.hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return
    if os.access(folder, os.W_OK):
        os.environ["NUMBA_CACHE_DIR"] = str(folder)


_keep_compiled_kernels_apart()
