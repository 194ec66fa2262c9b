"""The terminal as a listener: progress bars, tables and sentences of a command."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
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
        """Show a right-aligned table and, below it, what its headings mean.

        A table that is too wide is shown in parts, each with the first column; numbers and their units stay together.
        """
        self.console.print(Text(printable(title), style="italic"))
        columns = [[Text(printable(cell)) for cell in column] for column in zip(headings, *rows, strict=True)]
        for part, widths in _parts(columns, self.console.width):
            table = Table(box=SIMPLE_HEAD, show_edge=False, padding=0)
            for (heading, *_), width in zip(part, widths, strict=True):
                table.add_column(heading, justify="right", overflow="fold", width=width)
            for row in zip(*(cells for _, *cells in part), strict=True):
                table.add_row(*row)
            self.console.print(table)
        if note:
            self.console.print(Text(printable(note), style="dim"))


#: Where a line of a table may break: not between a number and its unit, but before what stands in brackets.
_BREAKS = re.compile(r"(?<!\d) | (?=\()")


def _parts(columns: Sequence[list[Text]], available: int) -> Iterator[tuple[list[list[Text]], list[int]]]:
    """Divide columns among tables so narrow that each fits, with the first column in all of them.

    Args:
        columns: Cells of every column, its heading first.
        available: Width of the terminal, in characters.

    Yields:
        The columns of a table and their widths, in characters.
    """
    least = [max(cell_len(piece) for cell in column for piece in _BREAKS.split(cell.plain)) for column in columns]
    parts = [[0]]
    for number in range(1, len(columns)):
        if sum(least[each] + 1 for each in parts[-1]) + least[number] > available and len(parts[-1]) > 1:
            parts.append([0])
        parts[-1].append(number)
    for part in parts:
        widths = {number: least[number] for number in part}
        spare = available - sum(widths.values()) - len(part) + 1
        missing = {number: max(cell.cell_len for cell in columns[number]) - least[number] for number in part}
        # Columns that need least to show their cells in one line get it first.
        for number in sorted(part, key=missing.__getitem__):
            given = max(0, min(spare, missing[number]))
            widths[number] += given
            spare -= given
        yield [columns[number] for number in part], list(widths.values())


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
