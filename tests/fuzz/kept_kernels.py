"""Campaign: kept kernels whose files are damaged at random are never loaded.

    python -m tests.fuzz.kept_kernels --seconds 60 --seed 0

A damaged file must be as good as none. The code itself is machine code, so one that is loaded all the same could
compute anything, or end the process.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numba import types
from numba.core.registry import cpu_target

from tests.fuzz.trials import options
from triform import kernels

_SIGNATURE = (types.int64, types.int64)


def fresh() -> Any:
    """A kernel that has not been called yet; what an earlier one left in the folder is its code too."""

    def double_and_add(x: int, y: int) -> int:
        return 2 * x + y

    double_and_add.__module__ = "triform.kernels"
    return kernels.kernel(double_and_add)


@dataclass
class KeptKernel:
    """The kernel's file in a folder, and what it holds."""

    folder: Path
    path: Path = field(init=False)
    whole: bytes = field(init=False)

    def __post_init__(self) -> None:
        assert fresh()(20, 1) == 41
        (self.path,) = self.folder.glob("*.kernel")
        self.whole = self.path.read_bytes()


def mutate(whole: bytes, rng: np.random.Generator) -> bytes:
    """Flip bits, cut, repeat, insert or overwrite; never the same bytes."""
    at, length = int(rng.integers(len(whole))), int(rng.integers(1, 200))
    other = rng.bytes(length)
    changed = bytearray(whole)
    kind = rng.integers(5)
    if kind == 0:
        for place in rng.integers(len(whole), size=rng.integers(1, 4)):
            changed[place] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        del changed[at:]
    elif kind == 2:
        changed[at:at] = other
    elif kind == 3:
        changed[at : at + length] = other
    else:
        changed += other
    return bytes(changed) if changed != whole else b""


def campaign(
    kept: KeptKernel, *, tries: int = sys.maxsize, seconds: float = np.inf, seed: int
) -> tuple[int, list[int]]:
    """Try mutations; return how many were tried and the numbers of those that were loaded."""
    rng = np.random.default_rng(seed)
    cache = fresh()._cache
    target = cpu_target.target_context
    end = time.monotonic() + seconds
    tried, loaded = 0, []
    while tried < tries and time.monotonic() < end:
        kept.path.write_bytes(mutate(kept.whole, rng))
        if cache.load_overload(_SIGNATURE, target) is not None:
            loaded.append(tried)
        tried += 1
    kept.path.write_bytes(kept.whole)
    assert cache.load_overload(_SIGNATURE, target) is not None
    return tried, loaded


def main() -> int:
    """Run the campaign; 1 if a damaged kernel was loaded."""
    given = options(__doc__ or "", sys.maxsize, 60.0)
    with tempfile.TemporaryDirectory() as folder:
        kernels._FOLDER = Path(folder)
        tried, loaded = campaign(KeptKernel(Path(folder)), tries=given.tries, seconds=given.seconds, seed=given.seed)
    for number in loaded:
        sys.stdout.write(f"loaded: mutation {number} of seed {given.seed}\n")
    sys.stdout.write(f"kept kernels: {tried} tried, {len(loaded)} failed\n")
    return int(bool(loaded))


if __name__ == "__main__":
    sys.exit(main())
