"""Signals that end a run between two of its steps."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType


class StopSignals:
    """Notes Ctrl-C, SIGTERM and a closed terminal, so that they never cut a message to a robot or a line of a file.

    A program under ``nohup`` goes on when its terminal is closed. Works in a program's main thread only.
    """

    def __init__(self) -> None:
        """Note nothing yet."""
        self._received: int | None = None

    def __enter__(self) -> StopSignals:
        """Begin to listen."""
        noted = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
            noted.append(signal.SIGHUP)
        self._before = {each: signal.signal(each, self._note) for each in noted}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave signals to those who had them before."""
        for each, handler in self._before.items():
            signal.signal(each, handler)

    def check(self) -> None:
        """End the run if a signal came.

        Raises:
            SystemExit: It did; with 128 and its number, the exit status of processes that a signal ends.
        """
        if self._received is not None:
            raise SystemExit(128 + self._received)

    def _note(self, number: int, _: FrameType | None) -> None:
        self._received = self._received or number
        # Whoever presses Ctrl-C again does not want to wait.
        signal.signal(signal.SIGINT, signal.default_int_handler)
