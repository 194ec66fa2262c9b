"""The campaign of random command lines, for a few seconds."""

from __future__ import annotations

from tests.fuzz.command_line import SMALL, Answer, fault, run
from triform.cli import COMMANDS


def test_random_command_lines_end_in_a_sentence() -> None:
    ends, failures = run(tries=6, seconds=None, seed=5, limit=120)
    assert not failures, failures[0]
    assert ends.total() == 6


def test_every_command_is_called() -> None:
    assert set(SMALL) == set(COMMANDS)


def test_faults_are_found() -> None:
    assert not fault("show", Answer(0, "", 1.0, interrupted=False))
    assert not fault("train", Answer(130, "triform: interrupted", 60.0, interrupted=True))
    for command, answer in (
        ("evaluate", Answer(130, "triform: interrupted", 60.0, interrupted=True)),
        ("evaluate", Answer(None, "", 1.0, interrupted=False)),
        ("evaluate", Answer(1, "Traceback (most recent call last)", 1.0, interrupted=False)),
        ("evaluate", Answer(1, "oh", 1.0, interrupted=False)),
        ("evaluate", Answer(2, "\x1b[2J", 1.0, interrupted=False)),
    ):
        assert fault(command, answer)
