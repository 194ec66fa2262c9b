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


#: Upper bound of the first bin [s], ratio of the bounds of a bin, and number of bins: up to 1000 s.
_SHORTEST, _RATIO, _BINS = 1e-6, 1.002, 10_400


class Durations:
    """How often each duration came, in bins: as much memory after a day as after a second."""

    def __init__(self) -> None:
        """Begin with none."""
        self._counts = np.zeros(_BINS, dtype=np.int64)
        self._longest = -math.inf

    def add(self, seconds: float) -> None:
        """Count a duration [s]."""
        self._longest = max(self._longest, seconds)
        self._counts[min(_BINS - 1, int(math.log(max(1.0, seconds / _SHORTEST)) / math.log(_RATIO)))] += 1

    def summary(self) -> dict[str, float]:
        """Return median and 95 % quantile, to 0.1 % and a microsecond, and the maximum [s]; empty without durations."""
        reached = np.cumsum(self._counts)
        if not reached[-1]:
            return {}
        bins = np.searchsorted(reached, np.array([0.5, 0.95]) * reached[-1])
        median, p95 = np.minimum(_SHORTEST * _RATIO ** (bins + 0.5), self._longest).tolist()
        return {"median": median, "p95": p95, "max": self._longest}


class Budget:
    """Collects the latencies of every step: sense, map, policy, send, and their total.

    Only the learned policy tells when its maps are made; other controllers count as policy as a whole.
    """

    def __init__(self) -> None:
        """Begin with nothing."""
        self._mapped = -math.inf
        self._parts = {name: Durations() for name in PARTS}
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
            self._parts[name].add(seconds)

    def summary(self) -> dict[str, Any]:
        """Return counts, and median, 95 % quantile and maximum of every part [s]."""
        counts = ("steps", "late_ticks", "blind_steps", "scans_used", "scans_missed")
        return {
            **{name: getattr(self, name) for name in counts},
            "seconds": {name: found for name, durations in self._parts.items() if (found := durations.summary())},
        }

    def _count_turn(self, turn: Turn) -> None:
        last = self._turn
        if last is not None and turn.ended <= last.ended:
            return
        self.scans_used += 1
        if last is not None:
            self.scans_missed += max(0, round((turn.started - last.ended) / (turn.ended - turn.started)))
        self._turn = turn
