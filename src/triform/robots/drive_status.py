"""What a driving robot tells its people: a line that lives, and where the time from scan to wheels went."""

from __future__ import annotations

import math
import time
from types import TracebackType
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.live import Live
from rich.table import Table
from rich.text import Text

from triform.control.detection import detect_robots
from triform.robots.real import Step, Turn
from triform.robots.screen import Screen

#: Parts of the way from a finished scan to the wheels, and what each is.
PARTS = {
    "sense": "age of the scan when it is used",
    "map": "scan to map",
    "policy": "map to command",
    "send": "command to the base",
    "total": "end of the scan to the base",
}


class Budget:
    """Collects the latencies of every step: sense, map, policy, send, and their total.

    Only the learned policy tells when its maps are made; other controllers count as policy as a whole.
    """

    def __init__(self) -> None:
        """Begin with nothing."""
        self._mapped = -math.inf
        self._parts: dict[str, list[float]] = {name: [] for name in PARTS}
        self._turn: Turn | None = None
        self.steps = 0
        self.late_ticks = 0
        self.blind_steps = 0
        self.scans_used = 0
        self.scans_missed = 0

    def clock(self) -> None:
        """Note that the map is made: the ``clock`` of a ``LearnedPolicy``."""
        self._mapped = time.monotonic()

    def add(self, step: Step) -> None:
        """Count a step whose command has been sent."""
        self.steps += 1
        self.late_ticks += step.late
        if step.turn is None or step.blind:
            self.blind_steps += 1
            return
        self._count_turn(step.turn)
        parts = {"sense": step.scan_age, "send": step.sent - step.decided, "total": step.latency}
        thought_since = step.seen
        if step.seen <= self._mapped <= step.decided:
            parts["map"] = self._mapped - step.seen
            thought_since = self._mapped
        parts["policy"] = step.decided - thought_since
        for name, seconds in parts.items():
            self._parts[name].append(seconds)

    def summary(self) -> dict[str, Any]:
        """Return counts, and median, 95 % quantile and maximum of every part [s]."""
        counts = ("steps", "late_ticks", "blind_steps", "scans_used", "scans_missed")
        return {
            **{name: getattr(self, name) for name in counts},
            "seconds": {
                name: {
                    "median": float(np.median(seconds)),
                    "p95": float(np.quantile(seconds, 0.95)),
                    "max": float(np.max(seconds)),
                }
                for name, seconds in self._parts.items()
                if seconds
            },
        }

    def print(self, screen: Screen) -> None:
        """Show the table of latencies and the counts."""
        table = Table(title="latency [ms]", title_justify="left", box=SIMPLE_HEAD, show_edge=False, padding=0)
        table.add_column("part")
        for heading in ("median", "95 %", "max"):
            table.add_column(heading, justify="right", min_width=8)
        table.add_column("  what")
        for name, quantiles in self.summary()["seconds"].items():
            table.add_row(name, *(f"{1000 * value:.1f}" for value in quantiles.values()), f"  {PARTS[name]}")
        if table.row_count:
            screen.print(table)
        screen.print(
            f"{self.steps} commands, {self.late_ticks} late, {self.blind_steps} without a fresh scan; "
            f"{self.scans_used} scans used, {self.scans_missed} missed"
        )

    def _count_turn(self, turn: Turn) -> None:
        last = self._turn
        if last is not None and turn.ended <= last.ended:
            return
        self.scans_used += 1
        if last is not None:
            self.scans_missed += max(0, round((turn.started - last.ended) / (turn.ended - turn.started)))
        self._turn = turn


class StatusLine:
    """One line about the robot: four times a second on a terminal, else a new one every second."""

    def __init__(self, screen: Screen, footprint: tuple[float, float] | float, dry_run: bool) -> None:
        """Prepare the line.

        Args:
            screen: Where to.
            footprint: Length and width of the robots, or the diameter of a circle, by which neighbours are counted [m].
            dry_run: Whether commands are shown only.
        """
        self._screen = screen
        self._footprint = footprint
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
            neighbours = int(detect_robots(step.view.scans, self._footprint)[1].sum())
            sight = (
                f"scan {1000 * step.scan_age:.0f} ms old, on the wheels after "
                f"{1000 * step.latency:.0f} ms, neighbours {neighbours}"
            )
        return Text(
            f"{step.view.time:.1f} s, {rate:.1f} Hz, {sight}, {self._verb} {forward:+.2f} {left:+.2f} m/s "
            f"{turning:+.2f} rad/s"
        )
