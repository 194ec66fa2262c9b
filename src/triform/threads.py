"""How many threads a parallel kernel is worth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numba


@contextmanager
def threads_for(work: int, work_per_thread: int) -> Iterator[None]:
    """Let the kernels called inside use no more threads than ``work`` is worth; results never depend on it.

    On a machine whose cores are busy otherwise, waiting for a second thread can take a whole time slice (10 ms and
    more), so each thread should have a few milliseconds of work of its own.
    """
    allowed = numba.get_num_threads()
    numba.set_num_threads(min(allowed, max(1, work // work_per_thread)))
    try:
        yield
    finally:
        numba.set_num_threads(allowed)
