"""``triform conditions``: a controller under many conditions."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from triform.commands.terminal import Terminal
from triform.experiments.conditions import ConditionsConfig, run_conditions


@dataclass(frozen=True)
class Conditions(ConditionsConfig):
    """Options of ``triform conditions``."""

    def run(self, console: Console) -> None:
        """Run the command and show its results on a console."""
        run_conditions(self, Terminal(console))
