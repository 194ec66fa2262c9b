"""Mini-batches made ahead of time, side by side in background threads, and delivered in order."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

from triform.threads import limit_threads

Item = TypeVar("Item")

#: Items that wait for the consumer, beyond those in the making.
_AHEAD = 4


class Prefetched(Generic[Item]):
    """Runs tasks in the background; use as a context manager and iterate over their results.

    Which thread runs a task changes nothing about its result, and results come in the order of the tasks.

    Attributes:
        waited: Time that the consumer has spent waiting for a result [s].
    """

    def __init__(self, tasks: Iterator[Callable[[], Item]], producers: int) -> None:
        """Run ``tasks`` in ``producers`` threads."""
        self.waited = 0.0
        self._tasks = tasks
        self._ahead = producers + _AHEAD
        self._pool = ThreadPoolExecutor(producers, thread_name_prefix="batches")
        self._coming: deque[Future[Item]] = deque()

    def __enter__(self) -> Iterator[Item]:
        return self._consume()

    def _consume(self) -> Iterator[Item]:
        while True:
            for task in self._tasks:
                self._coming.append(self._pool.submit(_alone, task))
                if len(self._coming) > self._ahead:
                    break
            if not self._coming:
                return
            began = time.perf_counter()
            item = self._coming.popleft().result()
            self.waited += time.perf_counter() - began
            yield item

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)


def _alone(task: Callable[[], Item]) -> Item:
    # Tasks run side by side, so none needs threads of its own.
    with limit_threads(1):
        return task()
