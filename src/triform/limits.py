"""Limits of what is asked for: numbers that no work has, and more memory than this machine has."""

from __future__ import annotations

import os
from pathlib import Path

from triform.types import ConfigurationError, require

#: Where Linux says how much memory a container may use; the word max instead of a number is no limit.
_CONTAINER_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
#: The largest seed and the largest index that files and generators of random numbers take.
LARGEST_SEED, LARGEST_INDEX = 2**63 - 1, 10**9
_MOST_THREADS = 4096


def require_at_most(name: str, value: float | None, most: float, unit: str = "") -> None:
    """Refuse a number that no work has; ``None`` is none.

    Raises:
        ConfigurationError: It is larger than ``most``.
    """
    require(value is None or value <= most, f"{name} is {value}{unit}; at most {most:,}{unit} is allowed")


def check_threads(threads: int | None) -> None:
    """Refuse numbers of threads that no machine has.

    Raises:
        ConfigurationError: It is not positive, or larger than 4,096.
    """
    require(threads is None or threads >= 1, f"threads is {threads}; at least 1 is needed")
    require_at_most("threads", threads, _MOST_THREADS)


def memory() -> int | None:
    """Return the memory of this machine or container [bytes]; ``None`` where the system does not say it."""
    try:
        found = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None
    for path in _CONTAINER_LIMITS:
        try:
            found = min(found, int(path.read_text()))
        except (OSError, ValueError):
            continue
    return found


def require_memory(needed: float, work: str) -> None:
    """Refuse work that needs more memory than there is.

    Args:
        needed: About how much it needs [bytes].
        work: What it is, as the subject of a sentence.

    Raises:
        ConfigurationError: This machine has less.
    """
    found = memory()
    if found is not None and needed > found:
        raise ConfigurationError(
            f"{work} would need about {needed / 1e9:,.0f} GB of memory, and this machine has {found / 1e9:,.0f} GB"
        )
