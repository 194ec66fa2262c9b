"""``triform drive``: one robot, LiDAR to wheels."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from triform.commands.drive_screen import DriveScreen
from triform.robots.drive import DriveConfig, run_drive


@dataclass(frozen=True)
class Drive(DriveConfig):
    """Options of ``triform drive``."""

    def run(self, console: Console) -> None:
        """Drive, show how it goes, and where the time went."""
        run_drive(self, DriveScreen(console, self.outline, self.dry_run))
