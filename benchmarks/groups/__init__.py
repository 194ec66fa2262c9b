"""The groups of rows, in the order of the report."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator

from benchmarks.report import Row
from benchmarks.runner import Group
from benchmarks.settings import Settings, Watch

_TITLES = {
    "limits": "The machine's limits",
    "scans": "LiDAR scans against other simulators",
    "maps": "Scan and Algorithm 3",
    "policy": "The policy against the dense network",
    "share": "Share of the machine's matrix-multiply rate",
    "step": "One robot, from scan to command",
    "lidar": "Reading a LiDAR",
    "training": "Training",
    "evaluation": "triform evaluate, Table I",
    "scaling": "From 100 to 100,000 robots in one world",
    "measures": "The protocol's measures on a large team",
    "page": "The live page with 100 robots",
}


def measure_module(name: str, settings: Settings, watch: Watch) -> Iterator[Row]:
    """Rows of a module of this package, which is loaded only now: what it lacks is its own failure."""
    yield from importlib.import_module(f"{__name__}.{name}").measure(settings, watch)


GROUPS = {name: Group(name, title, functools.partial(measure_module, name)) for name, title in _TITLES.items()}
