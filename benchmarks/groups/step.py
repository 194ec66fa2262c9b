"""One robot's whole step, from scan to command, on one thread."""

from __future__ import annotations

import functools
import time
import tracemalloc
from collections.abc import Iterator

import numpy as np

from benchmarks.report import Aim, Row
from benchmarks.scenes import closed_loop_scans
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Spread, call_seconds
from triform.control import LearnedPolicy, shipped_weights
from triform.policy import PolicyRuntime
from triform.threads import limit_threads
from triform.types import FloatArray, Scan, View

#: Steps between two looks at the clock of the progress bar.
_CHUNK = 500


def measure(settings: Settings, watch: Watch) -> Iterator[Row]:
    """Median, tail and allocations with both shipped policies."""
    steps = 1000 if settings.quick else 20_000
    views = _views(settings)
    with limit_threads(1):
        for weights in ("large", "near"):
            policy = LearnedPolicy(PolicyRuntime(shipped_weights()[weights], threads=1))
            what = f"scan to command, one robot, 1 thread, `{weights}`"
            taken, idle = _step_times(policy, views, steps, watch, what)
            median = Spread.of(1e3 * taken, "ms")
            yield Row(f"{what}, median", median, Aim("<=", 0.35), note=f"{steps:,} steps, quartiles over them.")
            tails = {
                "the same time spent counting": Spread.once(_tail(idle), "ms"),
                "99th percentile": Spread.once(1e3 * float(np.quantile(taken, 0.99)), "ms"),
                "longest": Spread.once(1e3 * float(taken.max()), "ms"),
            }
            note = (
                "Between the steps a loop counts for as long as a median step: what its tail shows is the machine's "
                "doing, not the step's."
            )
            yield Row(f"{what}, 99.9th percentile", Spread.once(_tail(taken), "ms"), Aim("<=", 1.0), tails, note)
            peak, kept = _allocations(policy, views)
            yield Row(
                f"{what}, memory allocated and freed again in a step",
                Spread.of(peak, "kB"),
                sides={"kept after a step": Spread.once(kept, "B")},
                note="Of Python and NumPy, by tracemalloc: the most that is live at once. ONNX Runtime has its own.",
            )


def _views(settings: Settings) -> list[View]:
    """What single robots of a team of seven see, in the order of its runs."""
    scans = closed_loop_scans(7, settings)
    active = np.ones((1, 1), dtype=np.bool_)
    rows = scans.ranges.reshape(-1, 1, 1, scans.config.rays)
    return [View(Scan(each, scans.config), active, 0.0) for each in rows]


def _step_times(
    policy: LearnedPolicy, views: list[View], steps: int, watch: Watch, what: str
) -> tuple[FloatArray, FloatArray]:
    """Seconds of every step, and of a loop between the steps that takes as long and only counts."""
    for k in range(50):
        policy.command(views[k % len(views)])
    ticks = _ticks_of(float(np.median([call_seconds(functools.partial(policy.command, view)) for view in views])))
    taken, idle = np.empty(steps), np.empty(steps)
    for k in range(steps):
        if k % _CHUNK == 0:
            watch(what, k, steps)
        view = views[k % len(views)]
        began = time.perf_counter()
        policy.command(view)
        between = time.perf_counter()
        _count(ticks)
        idle[k] = time.perf_counter() - between
        taken[k] = between - began
    return taken, idle


def _count(ticks: int) -> None:
    for _ in range(ticks):
        pass


def _ticks_of(seconds: float) -> int:
    """How far to count so that it takes this long [s]."""
    trial = 10_000
    return max(1, round(trial * seconds / min(call_seconds(lambda: _count(trial)) for _ in range(20))))


def _tail(seconds: FloatArray) -> float:
    """99.9th percentile [ms]."""
    return 1e3 * float(np.quantile(seconds, 0.999))


def _allocations(policy: LearnedPolicy, views: list[View]) -> tuple[FloatArray, float]:
    """Most memory that each step had allocated at once [kB], and what a step leaves behind on average [bytes]."""
    peaks = np.empty(len(views))
    tracemalloc.start()
    try:
        policy.command(views[0])
        first = tracemalloc.get_traced_memory()[0]
        for k, view in enumerate(views):
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            policy.command(view)
            peaks[k] = (tracemalloc.get_traced_memory()[1] - before) / 1000
        kept = (tracemalloc.get_traced_memory()[0] - first) / len(views)
    finally:
        tracemalloc.stop()
    return peaks, kept
