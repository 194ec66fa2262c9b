"""What a long experiment tells whoever watches: libraries report, and only a command knows a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


class Advance(Protocol):
    """Moves a progress bar forward."""

    def __call__(self, steps: float = 1) -> None:
        """Note that ``steps`` more steps are done."""
        ...


class Listener(Protocol):
    """Hears of the progress and the results of an experiment."""

    def progress(self, description: str, total: float) -> AbstractContextManager[Advance]:
        """Follow work of ``total`` steps while a block runs."""
        ...

    def say(self, sentence: str) -> None:
        """Hear a sentence."""
        ...

    def milestone(self, sentence: str) -> None:
        """Hear what is done, where no progress bar can be drawn."""
        ...

    def table(self, title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], note: str = "") -> None:
        """Take a table of results, and what its headings mean."""
        ...


class _Silent:
    """Hears nothing."""

    @contextmanager
    def progress(self, description: str, total: float) -> Iterator[Advance]:  # noqa: ARG002
        """Follow nothing."""
        yield lambda steps=1: None  # noqa: ARG005

    def say(self, sentence: str) -> None:
        """Drop a sentence."""

    def milestone(self, sentence: str) -> None:
        """Drop a milestone."""

    def table(self, title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], note: str = "") -> None:
        """Drop a table."""


#: For callers that watch nothing.
SILENT: Listener = _Silent()
