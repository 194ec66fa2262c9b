"""The terminal as a listener: progress bars, tables and sentences of a command."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from triform.report.listener import Advance
from triform.types import printable


class Terminal:
    """A ``Listener`` on a console. What it shows is text, never markup."""

    def __init__(self, console: Console) -> None:
        """Show things on a console."""
        self.console = console

    @contextmanager
    def progress(self, description: str, total: float) -> Iterator[Advance]:
        """Show a progress bar with the time left while the block runs; it vanishes afterwards."""
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=self.console, transient=True) as bar:
            task = bar.add_task(printable(description), total=total)
            yield lambda steps=1: bar.advance(task, steps)

    def say(self, sentence: str) -> None:
        """Show a sentence."""
        self.console.print(printable(sentence), markup=False, highlight=False, soft_wrap=True)

    def milestone(self, sentence: str) -> None:
        """Show what is done where no progress bar can be drawn."""
        if not self.console.is_terminal:
            self.say(sentence)

    def table(self, title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], note: str = "") -> None:
        """Show a right-aligned table and, below it, what its headings mean."""
        table = Table(title=Text(printable(title)), title_justify="left", box=SIMPLE_HEAD, show_edge=False, padding=0)
        for heading in headings:
            table.add_column(Text(printable(heading)), justify="right", overflow="fold")
        for row in rows:
            table.add_row(*(Text(printable(cell)) for cell in row))
        self.console.print(table)
        if note:
            self.console.print(Text(printable(note), style="dim"))


def on_terminal(name: str, config: type, work: Callable[[Any, Terminal], object]) -> type:
    """Return a class of options, as a command has it, that does ``work`` and shows it on a console.

    Args:
        name: Name of the class.
        config: Options of the work.
        work: Takes the options, and a listener.
    """

    def run(self: Any, console: Console) -> None:
        work(self, Terminal(console))

    return type(name, (config,), {"run": run})


def given_options(options: Any, *names: str) -> dict[str, Any]:
    """The options among ``names`` that were given; the preset decides the others."""
    return {name: getattr(options, name) for name in names if getattr(options, name) is not None}


@contextmanager
def maps_progress(console: Console) -> Iterator[Callable[..., None]]:
    """Give a function that updates a bar with the rate of the work and the time left.

    The bar appears with the first update, so that a refusal before the work stands alone.
    """
    bar = Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TextColumn("{task.fields[rate]:,.0f} maps/s"),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=console,
    )
    task = bar.add_task("", total=None, rate=0.0)

    def update(**fields: Any) -> None:
        bar.start()
        bar.update(task, **fields)

    try:
        yield update
    finally:
        if bar.live.is_started:
            bar.stop()
