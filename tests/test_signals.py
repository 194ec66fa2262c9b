from __future__ import annotations

import os
import signal
import threading

import pytest

from triform.signals import StopSignals

#: As training uses it.
POLITE = {"always": (), "unless_ignored": (signal.SIGINT, signal.SIGTERM)}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_is_noted_and_ends_the_run_where_it_is_checked(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with StopSignals() as signals:
        assert not signals.received
        signals.check()
        os.kill(os.getpid(), number)
        assert signals.received
        with pytest.raises(SystemExit) as ended:
            signals.check()
        assert ended.value.code == 128 + number
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("settings", [{}, POLITE])
def test_a_second_ctrl_c_acts_at_once(settings: dict) -> None:
    with StopSignals(**settings) as signals:
        os.kill(os.getpid(), signal.SIGINT)
        assert signals.received
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) == signal.default_int_handler


def test_what_is_ignored_stays_ignored_if_it_may() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with StopSignals(**POLITE) as signals:
            os.kill(os.getpid(), signal.SIGINT)
            assert not signals.received
            os.kill(os.getpid(), signal.SIGTERM)
            assert signals.received
            assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
        with StopSignals() as signals:
            os.kill(os.getpid(), signal.SIGINT)
            assert signals.received
    finally:
        signal.signal(signal.SIGINT, before)


def test_another_thread_notes_nothing_or_is_refused() -> None:
    found: list[object] = []

    def listen() -> None:
        with StopSignals(**POLITE) as signals:
            found.append(signals.received)
        try:
            with StopSignals():
                pass
        except ValueError:
            found.append("refused")

    thread = threading.Thread(target=listen)
    thread.start()
    thread.join()
    assert found == [False, "refused"]
