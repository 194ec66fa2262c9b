"""Stopping politely: a signal ends the training after the step under way, with its state saved."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Collect Ctrl-C and SIGTERM while the block runs; what it yields tells whether one came.

    A second Ctrl-C acts at once. Only the main thread can receive signals; elsewhere none is ever reported.
    """
    requested = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield requested.is_set
        return
    handlers = {number: signal.getsignal(number) for number in _SIGNALS}
    # A signal that this process was started to ignore stays ignored.
    before = {number: handler for number, handler in handlers.items() if handler not in (signal.SIG_IGN, None)}

    def remember(number: int, _frame: object) -> None:
        requested.set()
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, remember)
    try:
        yield requested.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
