"""``triform drive``: one robot, LiDAR to wheels."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from triform.robots.drive import DriveConfig, run_drive


@dataclass(frozen=True)
class Drive(DriveConfig):
    """Options of ``triform drive``."""

    def run(self, console: Console) -> None:
        """Run the command and show its results on a console."""
        run_drive(self, console)
