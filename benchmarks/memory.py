"""Peak memory of a world, in a process of its own: ``python -m benchmarks.memory ROBOTS`` prints bytes as JSON."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from benchmarks.scenes import crowd
from triform.simulation import World, get_profile


def _peak() -> int:
    """Most resident memory of this process so far [bytes]; a parent's does not count, as in ``getrusage``."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def use(robots: int) -> None:
    """Make a world, observe, step twice and observe again."""
    poses = crowd(robots)
    world = World(poses, get_profile("ideal"))
    world.observe()
    for _ in range(2):
        world.apply(np.zeros_like(poses), world.control_period)
        world.observe()


if __name__ == "__main__":
    # Compiling needs memory too, and is over when a large world is made.
    use(10)
    before = _peak()
    use(int(sys.argv[1]))
    sys.stdout.write(json.dumps({"before": before, "peak": _peak()}) + "\n")
