"""``triform emulate``: robots without hardware, byte for byte."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rich.console import Console

from triform.commands.screen import Screen
from triform.robots.emulate import EmulateConfig, run_emulate


@dataclass(frozen=True)
class Emulate(EmulateConfig):
    """Options of ``triform emulate``."""

    GROUPS: ClassVar[dict[str, tuple[str, ...]]] = {
        "start": ("seed", "index", "distance", "arena"),
        "lidar": ("lidar_model", "latency"),
        "network": ("address", "local_address"),
    }

    def run(self, console: Console) -> None:
        """Emulate, and show how to drive the robots."""
        screen = Screen(console)
        run_emulate(self, screen.say, screen.warn)
