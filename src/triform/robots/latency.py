"""Where the time from scan to wheels goes while a robot drives."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from triform.robots.laser_scan import Turn
from triform.robots.real import Step

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

    def _count_turn(self, turn: Turn) -> None:
        last = self._turn
        if last is not None and turn.ended <= last.ended:
            return
        self.scans_used += 1
        if last is not None:
            self.scans_missed += max(0, round((turn.started - last.ended) / (turn.ended - turn.started)))
        self._turn = turn
