"""What the machine can do at most: matrix products and memory bandwidth."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks.bandwidth import triads
from benchmarks.matmul import SIZE, products
from benchmarks.report import Row
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Spread, compare


def measure(settings: Settings, watch: Watch) -> Iterator[Row]:
    """Rates of large products in three libraries, and of the triad, on one and on all threads."""
    for threads in settings.thread_counts:
        what = f"product of {SIZE} x {SIZE} matrices, fp32, {threads} thread{'s' * (threads > 1)}"
        sides = products(threads)
        seconds = compare(sides, settings, watch, what)
        rates = {side.name: Spread.of(1e-9 / seconds[side.name], "GFLOP/s") for side in sides}
        best = max(rates, key=lambda name: rates[name].median)
        yield Row(what, rates[best], sides=rates, note=f"{best} is the fastest and counts as the machine's rate")
    what = "memory bandwidth, triad a = b + s c"
    for name, taken in compare(triads(settings).values(), settings, watch, what).items():
        yield Row(f"{what}, {name}", Spread.of(1e-9 / taken, "GB/s"), note="24 bytes an element, as STREAM counts")
