"""How long the protocol's measures take on one run of a large team."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.report import Aim, Row
from benchmarks.scenes import crowd
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Spread, call_seconds
from triform.control import Expert
from triform.evaluation import Trajectory, rollout
from triform.evaluation import measure as protocol_measures
from triform.simulation import World, get_profile

#: What "in seconds" may mean [s].
_SECONDS = 10.0


def measure(settings: Settings, watch: Watch) -> Iterator[Row]:
    """One run of 40 s under the expert, then its measures."""
    robots, duration = (50, 5.0) if settings.quick else (10_000, 40.0)
    rounds = 2 if settings.quick else 5
    # Compiles the kernels.
    protocol_measures(_run(10, 5.0, watch))
    began = time.perf_counter()
    trajectory = _run(robots, duration, watch)
    running = time.perf_counter() - began
    taken = np.empty(rounds)
    for turn in range(rounds):
        watch("measures", turn, rounds)
        taken[turn] = call_seconds(lambda: protocol_measures(trajectory))
    yield Row(
        f"all measures of a run, {robots:,} robots, {len(trajectory.time)} records, {settings.cores} cores",
        Spread.of(taken, "s"),
        Aim("<=", _SECONDS),
        {"the run itself, with its scans": Spread.once(running, "s")},
        "Gabriel graphs of all robots at every record; faces and connections at the ends.",
    )


def _run(robots: int, duration: float, watch: Watch) -> Trajectory:
    """A run [s] of one crowd under the expert that sees as far as the LiDAR."""
    world = World(crowd(robots), get_profile("ideal"))
    steps = itertools.count(1)
    total = round(duration / world.control_period)

    def on_step() -> None:
        watch(f"a run of {robots:,} robots", next(steps), total)

    return rollout(world, Expert.named("expert-sensed"), duration, on_step)
