"""Threads: how many a piece of work may use, and the splitting of loops over them.

Kernels are compiled for one thread each and release the interpreter's lock; ``in_parts`` gives every thread a range of
worlds, scans or robots. Results never depend on the number of threads.
"""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar

from triform.types import require

_limit: ContextVar[int | None] = ContextVar("threads", default=None)


def usable_threads() -> int:
    """Threads that work started here may use: the innermost ``limit_threads``, else the processors of this process."""
    limit = _limit.get()
    return _processors() if limit is None else limit


@contextmanager
def limit_threads(threads: int | None) -> Iterator[None]:
    """Let the work inside use no more than ``threads`` threads; ``None`` changes nothing.

    The limit holds in the thread that sets it; a worker thread sets its own.

    Raises:
        ConfigurationError: If ``threads`` is not positive.
    """
    require(threads is None or threads >= 1, f"threads is {threads}; it must be at least 1")
    token = _limit.set(usable_threads() if threads is None else threads)
    try:
        yield
    finally:
        _limit.reset(token)


def in_parts(kernel: Callable[[int, int], object], count: int, work: float, work_per_thread: float) -> None:
    """Call ``kernel(first, last)`` on ranges that make up ``range(count)``, side by side where that pays.

    On a machine whose cores are busy otherwise, waiting for a second thread can take a whole time slice (10 ms and
    more), so each thread should have a few milliseconds of work of its own.

    Args:
        kernel: Works on items ``first <= k < last``; several calls on disjoint ranges may run at once.
        count: Number of items.
        work: Size of the whole work, in any unit.
        work_per_thread: Work that keeps a thread busy for a few milliseconds, in the same unit.
    """
    parts = min(count, usable_threads(), max(1, int(work / work_per_thread)))
    if parts <= 1:
        kernel(0, count)
        return
    bounds = [count * part // parts for part in range(parts + 1)]
    pool = _pool(os.getpid())
    rest = [pool.submit(_alone, kernel, first, last) for first, last in itertools.pairwise(bounds[1:])]
    try:
        kernel(bounds[0], bounds[1])
    finally:
        for future in rest:
            future.exception()
    for future in rest:
        future.result()


def _alone(kernel: Callable[[int, int], object], first: int, last: int) -> None:
    """Do one part; parts of parts would wait for threads that wait for them."""
    with limit_threads(1):
        kernel(first, last)


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


@functools.cache
def _pool(_process: int) -> ThreadPoolExecutor:
    """Threads for the parts, made anew in a forked process, which inherits none."""
    return ThreadPoolExecutor(_processors(), thread_name_prefix="triform")
