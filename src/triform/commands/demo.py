"""``triform demo``: one team, drawn."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from triform.commands.terminal import Terminal
from triform.experiments.demo import DemoConfig, run_demo


@dataclass(frozen=True)
class Demo(DemoConfig):
    """Options of ``triform demo``."""

    def run(self, console: Console) -> None:
        """Run the command and show its results on a console."""
        run_demo(self, Terminal(console))
