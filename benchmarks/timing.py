"""Time in turns: A B A B ..., so that whatever else happens on the machine happens to both sides."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from benchmarks.settings import Settings, Watch
from triform.types import FloatArray


@dataclass(frozen=True)
class Side:
    """One side of a comparison.

    Attributes:
        name: What it is called in the table.
        work: The work.
        amount: How many things (scans, maps, steps) one call of ``work`` does.
    """

    name: str
    work: Callable[[], object]
    amount: float = 1.0


@dataclass(frozen=True)
class Spread:
    """A measured quantity over its repeats.

    Attributes:
        unit: Unit of the values.
        median: Median.
        lower: Lower quartile.
        upper: Upper quartile.
        least: Smallest value.
        most: Largest value.
        repeats: Number of values.
    """

    unit: str
    median: float
    lower: float
    upper: float
    least: float
    most: float
    repeats: int

    @classmethod
    def of(cls, values: FloatArray, unit: str) -> Spread:
        """Summarise values."""
        least, lower, median, upper, most = (float(q) for q in np.quantile(values, [0, 0.25, 0.5, 0.75, 1]))
        return cls(unit, median, lower, upper, least, most, len(values))

    @classmethod
    def once(cls, value: float, unit: str) -> Spread:
        """A quantity that was measured or counted once."""
        return cls(unit, value, value, value, value, value, 1)


def call_seconds(work: Callable[[], object]) -> float:
    """Time of one call [s]."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def compare(sides: Iterable[Side], settings: Settings, watch: Watch, what: str) -> dict[str, FloatArray]:
    """Time several sides in turns.

    A turn repeats the work until ``settings.slice_seconds`` have passed, by an estimate made before the first turn, so
    that turns of a fast and a slow side are comparably long.

    Returns:
        Seconds for one thing, by side, shape (rounds,).
    """
    chosen = list(sides)
    calls = {}
    for side in chosen:
        side.work()
        calls[side.name] = max(1, math.ceil(settings.slice_seconds / max(call_seconds(side.work), 1e-9)))
    taken: dict[str, list[float]] = {side.name: [] for side in chosen}
    for turn in range(settings.rounds):
        watch(what, turn, settings.rounds)
        for side in chosen:
            work, repeats = side.work, calls[side.name]
            began = time.perf_counter()
            for _ in range(repeats):
                work()
            taken[side.name].append((time.perf_counter() - began) / (repeats * side.amount))
    return {name: np.array(seconds) for name, seconds in taken.items()}
