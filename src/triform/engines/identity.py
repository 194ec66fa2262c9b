"""What decides the bits of results on a machine, so that machines that would differ are found out."""

from __future__ import annotations

import functools
import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

_PACKAGES = ("triform", "numba", "numpy", "onnxruntime", "pyarrow")


@functools.cache
def identity() -> dict[str, str]:
    """Versions of what computes here, a checksum of triform's own sources, and the kind of processor.

    Versions alone do not tell: the sources of a version under development change, the C library has the sine of the
    kernels, and NumPy chooses its own by the vector instructions of the processor.
    """
    vectors = np.lib.introspect.opt_func_info(func_name="^sin$", signature="float64")["sin"]
    return {
        **{name: _version(name) for name in _PACKAGES},
        "sources of triform": _sources(Path(__file__).parent.parent),
        "Python": ".".join(platform.python_version_tuple()[:2]),
        "C library": " ".join(platform.libc_ver()),
        "processor": f"{platform.machine()} {next(iter(vectors.values()))['current']}",
    }


def differences(here: dict[str, str], there: dict[str, str]) -> str:
    """Say in which entries ``there`` differs from ``here``; empty if in none."""
    unlike = {name: value for name, value in here.items() if there.get(name) != value}
    return ", ".join(f"{name} {there.get(name, 'none')} instead of {value}" for name, value in unlike.items())


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


def _sources(folder: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]
