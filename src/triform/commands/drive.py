"""``triform drive``: one robot, LiDAR to wheels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from rich.console import Console

from triform.commands.drive_screen import DriveScreen
from triform.evaluation.senses import SensesLog
from triform.recordings.kept import check_kept
from triform.robots.drive import DriveConfig, run_drive
from triform.types import require


@dataclass(frozen=True)
class Drive(DriveConfig):
    """Options of ``triform drive``.

    Attributes:
        keep: File for odometry and commands, in Parquet, made of the recording when the drive ends.
        mcap: File for the same in MCAP with Foxglove's schemas, for viewers.
        scans: Whether these two also hold what the controller saw: scans, odometry and exploration noise.
    """

    GROUPS: ClassVar[dict[str, tuple[str, ...]]] = {
        "body": ("profile", "footprint", "max_speed", "max_turn_rate"),
        "lidar": ("lidar", "lidar_model", "mounting", "lidar_position", "upside_down", "blind_sector", "min_intensity"),
        "base": ("address", "usb", "local_address", "watchdog", "odometry"),
        "recording": ("record", "keep", "mcap", "scans", "robot", "start_pose"),
    }

    keep: Path | None = None
    mcap: Path | None = None
    scans: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_kept(self.keep, self.mcap, self.scans)
        for name, path in (("keep", self.keep), ("mcap", self.mcap)):
            require(path is None or self.record is not None, f"{name} is given without record, of which it is made")

    def run(self, console: Console) -> None:
        """Drive, show how it goes, and where the time went."""
        screen = DriveScreen(console, self.outline, self.dry_run, self.threshold)
        if self.record is None:
            run_drive(self, screen)
            return
        from triform.recordings.robots import keep_until_signal, write_drive

        record, seen = self.record, SensesLog()
        keep_until_signal(
            (self.keep, self.mcap),
            "odometry",
            lambda: run_drive(self, screen, seen.add if self.scans else None),
            lambda writer: write_drive(writer, record, self, seen.senses),
            screen.say,
        )
