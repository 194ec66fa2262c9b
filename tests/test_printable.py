"""Text that others wrote, as a terminal may show it."""

from __future__ import annotations

import io
import pickle

from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from triform.commands.screen import Screen
from triform.commands.terminal import Terminal
from triform.types import ConfigurationError, TriformError, printable

#: Everything, half of surrogate pairs too: names of files may hold them.
TEXT = st.text(st.characters(exclude_categories=[]))
HOSTILE = "\x1b[2J\x1b]0;owned\x07\x9b31m\r\n\u202e\udc80 [red]grün[/red]"


@given(TEXT)
def test_it_is_printable_and_says_all(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    assert printable(shown) == shown
    assert shown.encode().decode() == shown
    if text.isprintable():
        assert shown == text


@given(TEXT)
def test_errors_are_one_printable_sentence_and_travel(text: str) -> None:
    for kind in (TriformError, ConfigurationError):
        error = kind(f"it says {text}")
        assert str(error) == f"it says {printable(text)}"
        assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_nothing_that_is_shown_steers_the_terminal() -> None:
    shown = io.StringIO()
    console = Console(file=shown, width=200, force_terminal=False)
    Terminal(console).say(HOSTILE)
    Terminal(console).table("a", ["robot"], [[HOSTILE]])
    Screen(console).say(HOSTILE)
    Screen(console).warn(HOSTILE)
    lines = shown.getvalue().splitlines()
    assert sum("owned" in line and "[red]grün[/red]" in line for line in lines) == 4
    assert all(line.isprintable() for line in lines)
