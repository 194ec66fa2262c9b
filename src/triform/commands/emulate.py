"""``triform emulate``: robots without hardware, byte for byte."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from triform.robots.emulate import EmulateConfig, run_emulate


@dataclass(frozen=True)
class Emulate(EmulateConfig):
    """Options of ``triform emulate``."""

    def run(self, console: Console) -> None:
        """Run the command and show its results on a console."""
        run_emulate(self, console)
