"""``triform bench``: one robot's way from scan to command on this computer."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from triform.commands.terminal import Terminal
from triform.timing.robot import BenchConfig, run_bench


@dataclass(frozen=True)
class Bench(BenchConfig):
    """Options of ``triform bench``."""

    def run(self, console: Console) -> None:
        """Run the command and show its results on a console."""
        run_bench(self, Terminal(console))
