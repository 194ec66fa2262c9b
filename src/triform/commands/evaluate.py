"""``triform evaluate``: one controller on many starts."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from triform.commands.terminal import Terminal
from triform.experiments.evaluate import EvaluateConfig, run_evaluate


@dataclass(frozen=True)
class Evaluate(EvaluateConfig):
    """Options of ``triform evaluate``."""

    def run(self, console: Console) -> None:
        """Run the command and show its results on a console."""
        run_evaluate(self, Terminal(console))
