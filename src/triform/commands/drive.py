"""``triform drive``: one robot, LiDAR to wheels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from rich.console import Console

from triform.commands.drive_screen import DriveScreen
from triform.recordings.kept import check_kept, keep_runs
from triform.robots.drive import DriveConfig, run_drive
from triform.types import require


@dataclass(frozen=True)
class Drive(DriveConfig):
    """Options of ``triform drive``.

    Attributes:
        keep: File for odometry and commands, in Parquet, made of the recording when the drive ends.
        mcap: File for the same in MCAP with Foxglove's schemas, for viewers.
    """

    GROUPS: ClassVar[dict[str, tuple[str, ...]]] = {
        "body": ("profile", "footprint", "max_speed", "max_turn_rate"),
        "lidar": ("lidar", "lidar_model", "mounting", "lidar_position", "upside_down", "blind_sector", "min_intensity"),
        "base": ("address", "usb", "local_address", "watchdog", "odometry"),
        "recording": ("record", "keep", "mcap", "robot", "start_pose"),
    }

    keep: Path | None = None
    mcap: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_kept(self.keep, self.mcap)
        for name, path in (("keep", self.keep), ("mcap", self.mcap)):
            require(path is None or self.record is not None, f"{name} is given without record, of which it is made")

    def run(self, console: Console) -> None:
        """Drive, show how it goes, and where the time went."""
        screen = DriveScreen(console, self.outline, self.dry_run, self.threshold)
        if self.record is None or (self.keep is None and self.mcap is None):
            run_drive(self, screen)
            return
        from triform.recordings.robots import write_drive

        with keep_runs(self.keep, self.mcap, source="odometry") as writer:
            ended = None
            try:
                run_drive(self, screen)
            except SystemExit as error:
                # A signal ends most drives.
                ended = error
            write_drive(writer, self.record, self)
        screen.say(f"kept in {' and '.join(str(path) for path in (self.keep, self.mcap) if path is not None)}")
        if ended is not None:
            raise ended
