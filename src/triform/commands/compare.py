"""``triform compare``: controllers side by side."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from triform.commands.terminal import Terminal
from triform.experiments.compare import CompareConfig, run_compare


@dataclass(frozen=True)
class Compare(CompareConfig):
    """Options of ``triform compare``."""

    def run(self, console: Console) -> None:
        """Run the command and show its results on a console."""
        run_compare(self, Terminal(console))
