"""Memory bandwidth: the triad of STREAM, ``a = b + s c``, on arrays far larger than the caches."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.machine import last_level_cache
from benchmarks.settings import Settings
from benchmarks.timing import Side
from triform.kernels import kernel
from triform.threads import in_parts, limit_threads

#: Bytes that one element moves as STREAM counts them: two read, one written.
ELEMENT_BYTES = 24


@kernel(fastmath=True)
def _triad(a: Any, b: Any, c: Any, scale: float, first: int, last: int) -> None:
    for k in range(first, last):
        a[k] = b[k] + scale * c[k]


def triads(settings: Settings) -> dict[int, Side]:
    """The triad by the number of threads; the amount is bytes."""
    length = 1_000_000 if settings.quick else last_level_cache() // 2
    a, b, c = np.zeros(length), np.ones(length), np.ones(length)

    def side(threads: int) -> Side:
        def work() -> None:
            with limit_threads(threads):
                in_parts(lambda first, last: _triad(a, b, c, 3.0, first, last), length, threads, 1)

        return Side(f"{threads} thread{'s' * (threads > 1)}", work, length * ELEMENT_BYTES)

    return {threads: side(threads) for threads in settings.thread_counts}
