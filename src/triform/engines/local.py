"""The local engine: threads of this process."""

from __future__ import annotations

import threading
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from queue import SimpleQueue

from triform.engines.interface import Item, Report, Result, Task
from triform.threads import limit_threads, usable_threads
from triform.types import require


class _StoppedError(Exception):
    """Another item failed or the user interrupts; this one is given up."""


class LocalEngine:
    """Works in threads; kernels and ONNX Runtime release the interpreter's lock, so they work side by side."""

    def __init__(self, threads: int | None = None) -> None:
        """Prepare to work.

        Args:
            threads: How many; as many as work started here may use if ``None``.

        Raises:
            ConfigurationError: If ``threads`` is not positive.
        """
        require(threads is None or threads >= 1, f"{threads} workers asked for; at least 1 is needed")
        self._threads = threads

    def run(
        self, task: Task[Item, Result], items: Sequence[Item], on_progress: Report | None = None
    ) -> Generator[tuple[int, Result], None, None]:
        """As ``Engine.run``; an item for which threads are left over, because few items are left, gets them too."""
        threads = usable_threads() if self._threads is None else self._threads
        events: SimpleQueue[float | Future[Result]] = SimpleQueue()
        stop = threading.Event()
        finished: list[Item] = []

        def go_on() -> None:
            if stop.is_set():
                raise _StoppedError

        def report(amount: float) -> None:
            go_on()
            events.put(amount)

        def work(item: Item) -> Result:
            go_on()
            try:
                # Those begun earlier, when more items were left, have no more threads than this one.
                with limit_threads(max(1, threads // (len(items) - len(finished)))):
                    result = task(item, report)
            except BaseException:
                # At once, so that this thread begins no other item before the caller hears of it.
                stop.set()
                raise
            finished.append(item)
            return result

        waiting = iter(enumerate(items))
        running: dict[Future[Result], int] = {}
        pool = ThreadPoolExecutor(threads, thread_name_prefix="triform-engine")
        try:
            while True:
                # A few ahead, so that no thread waits; no more, so that results do not pile up before they are taken.
                for index, item in islice(waiting, 2 * threads - len(running)):
                    future = pool.submit(work, item)
                    running[future] = index
                    future.add_done_callback(events.put)
                if not running:
                    return
                event = events.get()
                if isinstance(event, Future):
                    index = running.pop(event)
                    # The error for which this item was given up is still to come.
                    if not isinstance(event.exception(), _StoppedError):
                        yield index, event.result()
                elif on_progress is not None:
                    on_progress(event)
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)
