"""Calls of Ray, which may never come back: without its servers it waits for a minute and then ends the process."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeVar

from triform.engines import last_word
from triform.types import TriformError

Answer = TypeVar("Answer")

#: Time between two looks at the servers while a call takes its time [s].
_PERIOD = 0.2
#: Looks in a row that find no server before it counts as lost: a machine may be busy for a moment.
_LOOKS = 4
#: Ray's servers by the names of their processes.
SERVERS = {"gcs_server": "head", "raylet": "node on this machine"}


class Patience:
    """Makes calls of Ray in a thread of its own, and gives up those of a Ray that was lost."""

    def __init__(self) -> None:
        """Begin with a Ray that is not yet there."""
        self._calls: SimpleQueue[tuple[Future[Any], Callable[[], Any]]] = SimpleQueue()
        self._servers: dict[str, tuple[str, int]] = {}
        self._children: dict[int, str] = {}
        self._missed = 0
        self._speaker: subprocess.Popen[bytes] | None = None
        self.lost = ""
        # A thread that does not come back must not hold up the end of the process.
        threading.Thread(target=self._work, name="triform-ray", daemon=True).start()

    def _work(self) -> None:
        while True:
            done, call = self._calls.get()
            try:
                done.set_result(call())
            except BaseException as error:  # noqa: BLE001 - it is raised where the call was asked for
                done.set_exception(error)

    def __call__(self, call: Callable[[], Answer]) -> Answer:
        """Return what ``call`` returns.

        Raises:
            TriformError: If Ray was lost.
            Exception: What the call raised.
        """
        done: Future[Answer] = Future()
        self._calls.put((done, call))
        while True:
            try:
                return done.result(timeout=_PERIOD)
            except TimeoutError:
                if done.done():
                    raise
            self._look()

    def give_up(self, call: Callable[[], object], seconds: float) -> bool:
        """Make a last call without looking at the servers; whether it came back in time."""
        done: Future[object] = Future()
        self._calls.put((done, call))
        return not wait([done], seconds).not_done

    def watch(self, servers: dict[str, tuple[str, int]]) -> None:
        """Look from now on whether these servers, host and port by name, can be reached.

        Ray may end this process before it has looked; then a small process of its own says why.
        """
        self._servers = servers
        words = [str(word) for name, place in servers.items() for word in (name, *place)]
        # A session of its own, because a Ctrl-C of the terminal is not for it.
        self._speaker = subprocess.Popen(
            [sys.executable, "-I", last_word.__file__, *words], stdin=subprocess.PIPE, start_new_session=True
        )

    def farewell(self) -> None:
        """Say that this process needs Ray no more, and says itself what went wrong, if anything did."""
        speaker, self._speaker = self._speaker, None
        if speaker is not None:
            with suppress(OSError):
                speaker.communicate(b"\0")

    def _look(self) -> None:
        """Look whether Ray is still there.

        Raises:
            TriformError: If it is not.
        """
        gone = last_word.unreachable(self._servers) if self._servers else self._dead_child()
        self._missed = self._missed + 1 if gone else 0
        if self._missed >= _LOOKS or self.lost:
            self.lost = self.lost or gone
            raise TriformError(last_word.LOST.format(self.lost))

    def _dead_child(self) -> str:
        """A server that this process has started and that has ended, if the system tells."""
        tasks = Path("/proc/self/task").glob("*/children")
        for pid in (int(each) for path in tasks for each in path.read_text().split()):
            name = SERVERS.get(_state(pid)[0])
            if name is not None:
                self._children[pid] = name
        return next((name for pid, name in self._children.items() if _state(pid)[1] in "ZX"), "")


def _state(pid: int) -> tuple[str, str]:
    """Name and state of a process; state X if there is none."""
    try:
        name, _, rest = Path(f"/proc/{pid}/stat").read_text().partition("(")[2].rpartition(")")
    except OSError:
        return "", "X"
    return name, rest.split()[0]
