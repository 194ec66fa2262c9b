"""``triform ablate``: the triangulating law without each of its terms."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from triform.commands.terminal import Terminal
from triform.experiments.ablation import AblateConfig, run_ablate


@dataclass(frozen=True)
class Ablate(AblateConfig):
    """Options of ``triform ablate``."""

    def run(self, console: Console) -> None:
        """Run the command and show its results on a console."""
        run_ablate(self, Terminal(console))
