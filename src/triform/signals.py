"""Signals that end a run between two of its steps."""

from __future__ import annotations

import signal
import threading
from collections.abc import Sequence
from types import FrameType, TracebackType

#: SIGHUP, on systems that have it.
_HANG_UP = tuple(each for each in signal.Signals if each.name == "SIGHUP")


class StopSignals:
    """Notes signals that ask for an end, so that they never cut a message to a robot, a step or a line of a file.

    A second Ctrl-C acts at once. A signal that the program was started to ignore stays ignored if it is in
    ``unless_ignored``: a program under ``nohup`` goes on when its terminal is closed.
    """

    def __init__(
        self,
        always: Sequence[signal.Signals] = (signal.SIGINT, signal.SIGTERM),
        unless_ignored: Sequence[signal.Signals] = _HANG_UP,
    ) -> None:
        """Note nothing yet.

        Args:
            always: Signals to note. Only a program's main thread can do so; elsewhere they are refused.
            unless_ignored: Signals to note if the program was not started to ignore them; never outside its main
                thread.
        """
        self._always, self._unless_ignored = always, unless_ignored
        self._received: int | None = None

    def __enter__(self) -> StopSignals:
        """Begin to listen."""
        noted = list(self._always)
        if threading.current_thread() is threading.main_thread():
            noted += [each for each in self._unless_ignored if signal.getsignal(each) not in (signal.SIG_IGN, None)]
        self._before = {each: signal.signal(each, self._note) for each in noted}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave signals to those who had them before."""
        for each, handler in self._before.items():
            signal.signal(each, handler)

    @property
    def received(self) -> bool:
        """Whether a signal came."""
        return self._received is not None

    def check(self) -> None:
        """End the run if a signal came.

        Raises:
            SystemExit: It did; with 128 and its number, the exit status of processes that a signal ends.
        """
        if self._received is not None:
            raise SystemExit(128 + self._received)

    def _note(self, number: int, _: FrameType | None) -> None:
        self._received = self._received or number
        if signal.SIGINT in self._before:
            # Whoever presses Ctrl-C again does not want to wait.
            signal.signal(signal.SIGINT, signal.default_int_handler)
