"""The machine and the software that the measurements are about."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = ("triform", "numpy", "numba", "llvmlite", "onnxruntime", "torch", "vmas", "ir-sim")
#: Instructions that the arithmetic here can gain from; x86 and Arm names as Linux prints them.
_FLAGS = (
    "avx2",
    "fma",
    "avx512f",
    "avx512_bf16",
    "avx512_vnni",
    "avx_vnni",
    "amx_tile",
    "amx_bf16",
    "asimd",
    "asimddp",
    "bf16",
    "sve",
    "sve2",
)


def describe(cores: int) -> dict[str, Any]:
    """What was measured on, plain JSON values.

    Args:
        cores: Processors that the measurements are pinned to.
    """
    cpu = _cpu()
    flags = cpu.get("flags", cpu.get("Features", "")).split()
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": cpu.get("model name", platform.processor() or "unknown"),
        "architecture": platform.machine(),
        "instructions": " ".join(flag for flag in _FLAGS if flag in flags),
        "cores of the machine": os.cpu_count() or 0,
        "cores used": cores,
        "clock": f"{float(cpu['cpu MHz']) / 1000:.2f} GHz when looked at" if "cpu MHz" in cpu else "unknown",
        "caches": _caches(),
        "memory": f"{_memory_gib():.0f} GiB",
        "system": f"{platform.system()} {platform.release()}",
        "Python": platform.python_version(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "commit": _commit(),
        "load before": " ".join(f"{load:.2f}" for load in os.getloadavg()),
    }


def last_level_cache() -> int:
    """Size of the largest cache [bytes]; 32 MiB where the system does not say."""
    sizes = [_bytes(size) for _, _, size in _cache_levels()]
    return max(sizes, default=32 * 2**20)


def _cpu() -> dict[str, str]:
    """Fields of the first processor in /proc/cpuinfo."""
    path = Path("/proc/cpuinfo")
    if not path.exists():
        return {}
    first = path.read_text().split("\n\n")[0]
    fields = (line.partition(":") for line in first.splitlines())
    return {name.strip(): value.strip() for name, _, value in fields}


def _cache_levels() -> list[tuple[str, str, str]]:
    """Level, type and size of the first processor's caches."""
    folders = sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*"))
    names = ("level", "type", "size")
    found = [[(folder / name).read_text().strip() for name in names] for folder in folders]
    return [(level, kind, size) for level, kind, size in found]


def _caches() -> str:
    kinds = {"Data": "d", "Instruction": "i", "Unified": ""}
    return ", ".join(f"L{level}{kinds.get(kind, '')} {size}" for level, kind, size in _cache_levels()) or "unknown"


def _bytes(size: str) -> int:
    return int(size.rstrip("KMG")) * {"K": 2**10, "M": 2**20, "G": 2**30}.get(size[-1], 1)


def _memory_gib() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _commit() -> str:
    """Commit of the sources, and whether they have changed since."""
    folder = Path(__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + (", with changes" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
