"""What a step of one robot costs in worlds of very different sizes, and what a large world needs of memory."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.report import Aim, Row
from benchmarks.scenes import crowd
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Side, Spread, compare
from triform.control import Expert, LearnedPolicy, shipped_weights
from triform.policy import PolicyRuntime
from triform.simulation import ROBOMASTER_EP, Arena, World, cast_scans, get_profile
from triform.threads import limit_threads
from triform.types import ScanConfig


def measure(settings: Settings, watch: Watch) -> Iterator[Row]:
    """Expert, sensing, policy and the world's step, by the number of robots; then memory."""
    sizes = (100, 400) if settings.quick else (100, 1_000, 10_000, 100_000)
    worlds = {robots: World(crowd(robots), get_profile("ideal")) for robots in sizes}
    with limit_threads(1):
        for name, make, note in (
            ("expert", _expert, "Gabriel graph and springs, `expert-sensed`."),
            ("sensing", _sensing, "450 rays each; beyond the caches, the scans go out to memory."),
            ("policy `near`", _policy, "Scan to command: Algorithm 3, packing and the network."),
            ("World.apply", _applying, "0.1 s: ten steps with their contacts, and a scan."),
        ):
            what = f"{name}, time of a robot's step, 1 thread"
            sides = [Side(f"{robots:,} robots", make(world), robots) for robots, world in worlds.items()]
            seconds = compare(sides, settings, watch, what)
            yield Row(
                f"{what}: {sizes[-1]:,} robots in one world against {sizes[0]:,}",
                Spread.of(seconds[sides[-1].name] / seconds[sides[0].name], "x"),
                Aim("<=", 1.5),
                {side.name: Spread.of(1e6 * seconds[side.name], "µs") for side in sides},
                f"{note} Equally dense; of {sizes[0]:,} robots more stand at the edge, with fewer neighbours.",
            )
    watch("memory", 0, 1)
    yield _memory(sizes[-1])


def _expert(world: World) -> Callable[[], object]:
    expert, view = Expert.named("expert-sensed"), world.observe()
    return lambda: expert.command(view)


def _sensing(world: World) -> Callable[[], object]:
    poses, active, arena, scan = world.poses, world.active, Arena.open(), ScanConfig()
    return lambda: cast_scans(poses, active, ROBOMASTER_EP, arena, scan, dtype=np.float32)


def _policy(world: World) -> Callable[[], object]:
    policy, view = LearnedPolicy(PolicyRuntime(shipped_weights()["near"], threads=1)), world.observe()
    return lambda: policy.command(view)


def _applying(world: World) -> Callable[[], object]:
    still = np.zeros_like(world.poses)
    return lambda: world.apply(still, world.control_period)


def _memory(robots: int) -> Row:
    """Peak resident memory of a fresh process that makes a world, scans and steps."""
    command = [sys.executable, "-m", "benchmarks.memory", str(robots)]
    found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    scans = robots * ScanConfig().rays * 8 / 1e9
    return Row(
        f"memory of a world of {robots:,} robots with their scans",
        Spread.once(found["peak"] / 1e9, "GB"),
        Aim("<=", 1.0),
        {"before the world": Spread.once(found["before"] / 1e9, "GB"), "one scan of all": Spread.once(scans, "GB")},
        "Peak resident memory of a fresh process that makes the world, observes, steps and observes again; Python and "
        "its libraries included.",
    )
