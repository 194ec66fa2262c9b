"""``triform reproduce``: the paper's tables and figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.console import Console

from triform.commands.terminal import Terminal
from triform.experiments.reproduce import ReproduceConfig, What, run_reproduce


@dataclass(frozen=True)
class Reproduce(ReproduceConfig):
    """Options of ``triform reproduce``."""

    what: Annotated[What, tyro.conf.Positional] = "all"

    def run(self, console: Console) -> None:
        """Run the command and show its results on a console."""
        run_reproduce(self, Terminal(console))
