"""What ``triform drive`` shows: a line that lives, and where the time from scan to wheels went."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from triform.commands.screen import Screen
from triform.control import bright_returns
from triform.control.detection import detect_robots
from triform.robots.latency import PARTS
from triform.robots.real import Step


class DriveScreen(Screen):
    """A ``DriveListener`` on a console."""

    def __init__(
        self,
        console: Console,
        footprint: tuple[float, float] | float,
        dry_run: bool,
        min_intensity: float | None = None,
    ) -> None:
        """Show things on a console.

        Args:
            console: Where to.
            footprint: Length and width of the robots, or the diameter of a circle, by which neighbours are counted [m].
            dry_run: Whether commands are shown only.
            min_intensity: Dimmer returns are no neighbours; ``None`` if all count.
        """
        super().__init__(console)
        self._footprint, self._dry_run, self._least = footprint, dry_run, min_intensity

    @contextmanager
    def driving(self) -> Iterator[Callable[[Step], None]]:
        """Show a line about the last step while the block runs."""
        with StatusLine(self, self._footprint, self._dry_run, self._least) as line:
            yield line.show

    def ended(self, summary: dict[str, Any]) -> None:
        """Show the table of latencies and the counts of ``Budget.summary``."""
        table = Table(title="latency [ms]", title_justify="left", box=SIMPLE_HEAD, show_edge=False, padding=0)
        table.add_column("part")
        for heading in ("median", "95 %", "max"):
            table.add_column(heading, justify="right", min_width=8)
        table.add_column("  what")
        for name, quantiles in summary["seconds"].items():
            table.add_row(name, *(f"{1000 * value:.1f}" for value in quantiles.values()), f"  {PARTS[name]}")
        if table.row_count:
            self.print(table)
        self.say(
            f"{summary['steps']} commands, {summary['late_ticks']} late, {summary['blind_steps']} without a fresh "
            f"scan; {summary['scans_used']} scans used, {summary['scans_missed']} missed"
        )


class StatusLine:
    """One line about the robot: four times a second on a terminal, else a new one every second."""

    def __init__(
        self, screen: Screen, footprint: tuple[float, float] | float, dry_run: bool, min_intensity: float | None = None
    ) -> None:
        """Prepare the line.

        Args:
            screen: Where to.
            footprint: Length and width of the robots, or the diameter of a circle, by which neighbours are counted [m].
            dry_run: Whether commands are shown only.
            min_intensity: Dimmer returns are no neighbours; ``None`` if all count.
        """
        self._screen = screen
        self._footprint, self._least = footprint, min_intensity
        self._verb = "would send" if dry_run else "sent"
        self._live: Live | None = None
        self._period = 1.0
        if screen.console.is_terminal:
            self._live = Live(console=screen.console, auto_refresh=False, transient=True)
            self._period = 0.25
        self._shown = math.nan
        self._steps = 0

    def __enter__(self) -> StatusLine:
        """Take the line."""
        if self._live is not None:
            with self._screen.losing():
                self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the line back."""
        if self._live is not None:
            with self._screen.losing():
                self._live.stop()

    def show(self, step: Step) -> None:
        """Show a step if it is time to."""
        if math.isnan(self._shown):
            self._shown = step.sent
            return
        self._steps += 1
        passed = step.sent - self._shown
        if passed < self._period:
            return
        line = self._line(step, self._steps / passed)
        self._shown, self._steps = step.sent, 0
        if self._live is None:
            self._screen.print(line)
        else:
            with self._screen.losing():
                self._live.update(line, refresh=True)

    def _line(self, step: Step, rate: float) -> Text:
        # Adding zero turns a negative zero into zero.
        forward, left, turning = step.command.round(2) + 0.0
        if step.turn is None:
            sight = "no scan yet"
        elif step.blind:
            sight = f"no fresh scan for {step.scan_age:.1f} s"
        else:
            scans = step.view.scans if self._least is None else bright_returns(step.view.scans, self._least)
            neighbours = int(detect_robots(scans, self._footprint)[1].sum())
            sight = (
                f"scan {1000 * step.scan_age:.0f} ms old, on the wheels after "
                f"{1000 * step.latency:.0f} ms, neighbours {neighbours}"
            )
        return Text(
            f"{step.view.time:.1f} s, {rate:.1f} Hz, {sight}, {self._verb} {forward:+.2f} {left:+.2f} m/s "
            f"{turning:+.2f} rad/s"
        )
