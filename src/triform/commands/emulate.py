"""``triform emulate``: robots without hardware, byte for byte."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar

from rich.console import Console

from triform.commands.screen import Screen
from triform.recordings.kept import check_kept, keep_runs
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
        screen = Screen(console)
        if self.keep is None and self.mcap is None:
            run_emulate(self, screen.say, screen.warn)
            return
        from triform.recordings.robots import EmulationLog
        from triform.report.output import plain

        log, ended = EmulationLog(), None
        with keep_runs(self.keep, self.mcap) as writer:
            try:
                run_emulate(self, screen.say, screen.warn, log.add)
            except SystemExit as error:
                # A signal ends most emulations.
                ended = error
            log.write(writer, self)
            writer.describe(plain(asdict(self)))
        screen.say(f"kept in {' and '.join(str(path) for path in (self.keep, self.mcap) if path is not None)}")
        if ended is not None:
            raise ended
