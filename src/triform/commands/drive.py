"""``triform drive``: one robot, LiDAR to wheels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rich.console import Console

from triform.commands.drive_screen import DriveScreen
from triform.robots.drive import DriveConfig, run_drive


@dataclass(frozen=True)
class Drive(DriveConfig):
    """Options of ``triform drive``."""

    GROUPS: ClassVar[dict[str, tuple[str, ...]]] = {
        "body": ("profile", "footprint", "max_speed", "max_turn_rate"),
        "lidar": ("lidar", "lidar_model", "mounting", "lidar_position", "upside_down", "blind_sector", "min_intensity"),
        "base": ("address", "usb", "local_address", "watchdog", "odometry"),
        "recording": ("record", "robot", "start_pose"),
    }

    def run(self, console: Console) -> None:
        """Drive, show how it goes, and where the time went."""
        run_drive(self, DriveScreen(console, self.outline, self.dry_run, self.threshold))
