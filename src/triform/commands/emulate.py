"""``triform emulate``: robots without hardware, byte for byte."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from rich.console import Console

from triform.commands.screen import Screen
from triform.recordings.kept import check_kept
from triform.robots.emulate import EmulateConfig, run_emulate


@dataclass(frozen=True)
class Emulate(EmulateConfig):
    """Options of ``triform emulate``.

    Attributes:
        keep: File for true poses and commands, in Parquet, as triform measure reads them.
        mcap: File for the same in MCAP with Foxglove's schemas, for viewers.
    """

    GROUPS: ClassVar[dict[str, tuple[str, ...]]] = {
        "start": ("seed", "index", "distance", "arena"),
        "lidar": ("lidar_model", "latency"),
        "network": ("address", "local_address"),
        "recording": ("record", "keep", "mcap"),
    }

    keep: Path | None = None
    mcap: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_kept(self.keep, self.mcap)

    def run(self, console: Console) -> None:
        """Emulate, and show how to drive the robots."""
        from triform.recordings.robots import EmulationLog, keep_until_signal

        screen, log = Screen(console), EmulationLog()
        kept = self.keep, self.mcap
        on_record = log.add if any(kept) else None
        keep_until_signal(
            kept,
            "simulation",
            lambda: run_emulate(self, screen.say, screen.warn, on_record),
            lambda writer: log.write(writer, self),
            screen.say,
        )
