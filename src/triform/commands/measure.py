"""``triform measure``: recorded runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from triform.commands.terminal import Terminal
from triform.recordings.measure import MeasureConfig, run_measure


@dataclass(frozen=True)
class Measure(MeasureConfig):
    """Options of ``triform measure``."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]

    def run(self, console: Console) -> None:
        """Run the command and show its results on a console."""
        run_measure(self, Terminal(console))
