"""A console that may go away while a robot drives."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console, RenderableType

from triform.types import printable


class Screen:
    """Shows what there is to show; where that cannot be written any more, it is dropped and nothing else happens.

    A terminal may be closed, and the disk may be full to which the output goes: neither may end a run between two
    messages to a robot, or before its recording is whole.
    """

    def __init__(self, console: Console) -> None:
        """Show things on a console."""
        self.console = console

    def print(self, what: RenderableType, style: str | None = None) -> None:
        """Show something, as it is."""
        with self.losing():
            self.console.print(what, style=style, markup=False, highlight=False, soft_wrap=True)

    def say(self, sentence: str) -> None:
        """Show a sentence."""
        self.print(printable(sentence))

    def warn(self, sentence: str) -> None:
        """Show a warning."""
        self.print(f"warning: {printable(sentence)}", "yellow")

    @contextmanager
    def losing(self) -> Iterator[None]:
        """Drop all output from the first that cannot be written on."""
        try:
            yield
        except OSError:
            # What is still in buffers goes there too: it would fail once more when the program ends.
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self.console.file.fileno())
            os.close(null)
