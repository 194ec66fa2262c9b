"""Calls of Ray that do not come back, without Ray."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest

from triform.engines import last_word
from triform.engines.patience import Patience
from triform.types import TriformError


@pytest.fixture
def hanging() -> Iterator[threading.Event]:
    """An event that is set when the test is over, so that no thread stays."""
    event = threading.Event()
    yield event
    event.set()


def test_answers_and_errors_come_back() -> None:
    ask = Patience()
    assert ask(lambda: 7) == 7
    assert ask(threading.get_ident) == ask(threading.get_ident) != threading.get_ident()
    for error in (ValueError("no"), TimeoutError("late"), KeyboardInterrupt()):

        def fail(error: BaseException = error) -> None:
            raise error

        with pytest.raises(type(error)):
            ask(fail)


def test_a_call_is_given_up_when_its_server_is_gone_and_not_before(hanging: threading.Event) -> None:
    ask = Patience()
    with socket.create_server(("127.0.0.1", 0)) as server:
        ask.watch({"head": server.getsockname()})
        assert ask(lambda: time.sleep(1.0) or "slow") == "slow"
    with pytest.raises(TriformError, match=r"^Ray was lost: its head does not answer any more; what was finished"):
        ask(hanging.wait)
    # The thread is still with the call that does not come back.
    with pytest.raises(TriformError, match=r"^Ray was lost: its head"):
        ask(lambda: 7)
    assert not ask.give_up(lambda: 7, 0.1)
    hanging.set()
    assert ask.give_up(lambda: 7, 10.0)
    ask.farewell()


@pytest.mark.parametrize(
    ("reachable", "farewell", "says"),
    [(False, b"", "its head"), (False, b"\0", ""), (True, b"", ""), (True, b"\0", "")],
)
def test_the_last_word_of_an_ended_process_is_said_for_it(reachable: bool, farewell: bytes, says: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        words = ["head", *(str(word) for word in server.getsockname())]
        if not reachable:
            server.close()
        said = subprocess.run(
            [sys.executable, "-I", last_word.__file__, *words], input=farewell, capture_output=True, check=True
        ).stderr.decode()
    assert says in said
    assert bool(said) == bool(says)
    assert len(said.splitlines()) == bool(says)
