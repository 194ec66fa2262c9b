"""What workers of Ray report while they work: for progress only, so anything may get lost on the way."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from triform.engines.interface import Report

#: How often a worker reports [s].
_PERIOD = 1.0


class Noticeboard:
    """An actor on which workers pin how far they are, and its reader, who never waits for it."""

    def __init__(self) -> None:
        """Start the actor, on this machine if possible; it ends with the connection."""
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
        self.actor: Any = (
            ray.remote(_by_value()).options(num_cpus=0, max_restarts=-1, scheduling_strategy=here).remote()
        )
        self._asked: Any = None

    def read(self) -> dict[int, float]:
        """What every item reported in all, of those that did since the answer before; empty if none has come yet."""
        answer: dict[int, float] = {}
        with suppress(ray.exceptions.RayError):
            if self._asked is not None:
                ready, _ = ray.wait([self._asked], timeout=0)
                if not ready:
                    return answer
                asked, self._asked = self._asked, None
                answer = ray.get(asked)
            self._asked = self.actor.take.remote()
        return answer


def reporter(board: Any, key: int) -> tuple[Report, Callable[[], float]]:
    """Give a worker the function that its task reports with, and one that tells the sum so far.

    Args:
        board: ``Noticeboard.actor``; ``None`` if nobody reads it.
        key: Of the worker's item.
    """
    total, noted = 0.0, time.monotonic()

    def report(amount: float) -> None:
        nonlocal total, noted
        total += amount
        now = time.monotonic()
        if board is not None and now - noted >= _PERIOD:
            noted = now
            # Nothing that happens to a report may end the work.
            with suppress(Exception):
                board.pin.remote(key, total)

    return report, lambda: total


def _by_value() -> type:
    """The actor's class: a local one, which Ray sends whole, whatever its machine has installed."""

    class TriformNoticeboard:
        def __init__(self) -> None:
            self._pinned: dict[int, float] = {}

        def pin(self, key: int, total: float) -> None:
            self._pinned[key] = total

        def take(self) -> dict[int, float]:
            taken, self._pinned = self._pinned, {}
            return taken

    return TriformNoticeboard
