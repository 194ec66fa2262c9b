"""One robot's way from scan to command in a process of its own, as on the robot: its start, its stages, its memory.

``triform bench`` runs ``python -m triform.timing.robot_step SCANS JOB``, which prints JSON.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triform.control import LearnedPolicy, SafetyFilter, SafetySettings, weights_folder
from triform.policy import PolicyRuntime
from triform.robots.ldrobot import LD20, PACKET, PacketParser, TurnAssembler, encode_packets
from triform.robots.ldrobot.packets import CLOCK_WRAP
from triform.robots.ldrobot.port import READ_PERIOD
from triform.simulation import HARDWARE
from triform.threads import limit_threads
from triform.types import Controller, FloatArray, RangeArray, Scan, ScanConfig, View

_IMPORTED = time.monotonic()

#: What is timed, in the order in which it happens, and all of it together.
STAGES = ("parse", "map", "policy", "guard", "all")
#: Steps with cold caches.
_COLD_STEPS = 300
#: Before each of them, so much memory [bytes] is written and the processor pauses [s], as between two control periods.
_SWEPT = 2**26
_PAUSE = 0.005


@dataclass(frozen=True)
class Job:
    """What to time.

    Attributes:
        began: When the process was started, by the machine's monotonic clock [s].
        weights: Weights of the policy; the default ones if ``None``.
        distance: Prescribed neighbour distance d* [m].
        seconds: How long to take steps one after the other [s]; 0 for the start alone.
    """

    began: float
    weights: str | None
    distance: float
    seconds: float


@dataclass(frozen=True)
class Moment:
    """One turn of a robot's LiDAR.

    Attributes:
        reads: What the LiDAR sends, cut as its port reads it.
        view: What the robot sees then, B = N = 1.
    """

    reads: list[bytes]
    view: View


def save_moments(path: Path, views: Sequence[View]) -> None:
    """Write what single robots see, B = N = 1, with noise and odometry, to an ``.npz`` file."""
    np.savez(
        path,
        scan=json.dumps(asdict(views[0].scans.config)),
        ranges=np.array([view.scans.ranges[0, 0] for view in views]),
        noise=np.array([view.noise for view in views]),
        odometry=np.array([view.odometry for view in views]),
        time=np.array([view.time for view in views]),
    )


def load_moments(path: Path) -> list[Moment]:
    """Read what ``save_moments`` wrote, and add what the LiDARs send."""
    with np.load(path, allow_pickle=False) as saved:
        config = ScanConfig(**json.loads(str(saved["scan"])))
        active = np.ones((1, 1), dtype=np.bool_)
        columns = zip(*(saved[name] for name in ("ranges", "time", "noise", "odometry")), strict=True)
        return [
            Moment(
                [read.tobytes() for read in np.array_split(as_packets(ranges, turn), round(LD20.period / READ_PERIOD))],
                View(Scan(ranges[None, None], config), active, float(moment), noise=noise, odometry=odometry),
            )
            for turn, (ranges, moment, noise, odometry) in enumerate(columns)
        ]


def as_packets(ranges: RangeArray, turn: int) -> NDArray[np.uint8]:
    """Return the packets of an LD20 that measures a scan in its turn number ``turn``, as bytes, shape (K,).

    Args:
        ranges: Ranges of a full turn, counter-clockwise from behind the robot [m], shape (R,).
        turn: Turns before this one.
    """
    each = PACKET["samples"].shape[0]
    count = round(LD20.rays / each)
    # The LiDAR's own angles begin in front and grow clockwise.
    rays = np.rint(len(ranges) * (0.5 - np.arange(count * each) / (count * each))).astype(int) % len(ranges)
    packets = np.zeros(count, dtype=PACKET)
    first = np.arange(count) * each
    packets["speed"] = round(360 / LD20.period)
    packets["start_angle"] = np.rint(36000 * first / (count * each))
    packets["end_angle"] = np.rint(36000 * (first + each - 1) / (count * each))
    packets["samples"]["distance"] = np.where(np.isfinite(ranges), 1000 * ranges, 0).round()[rays].reshape(count, each)
    packets["timestamp"] = 1000 * LD20.period * (turn + (np.arange(count) + 1) / count) % CLOCK_WRAP
    return np.frombuffer(encode_packets(packets), dtype=np.uint8)


class _Stopwatch:
    """Notes moments [s]."""

    def __init__(self) -> None:
        self.noted: list[float] = []

    def __call__(self) -> None:
        self.noted.append(time.perf_counter())


class _Noting:
    """A controller that notes when it has decided, so that the filter around it can be timed by itself."""

    privileged = False

    def __init__(self, controller: Controller[View], watch: _Stopwatch) -> None:
        self.description = controller.description
        self._controller = controller
        self._watch = watch

    def command(self, view: View) -> FloatArray:
        commands = self._controller.command(view)
        self._watch()
        return commands


class Robot:
    """What runs on one robot between LiDAR and wheels, with a look at the clock after each stage."""

    def __init__(self, job: Job, scan: ScanConfig) -> None:
        """Load the policy, for scans of one kind."""
        self._watch = _Stopwatch()
        self._parser, self._assembler = PacketParser(), TurnAssembler(LD20, scan)
        self._time = 0.0
        policy = LearnedPolicy(PolicyRuntime(weights_folder(job.weights), threads=1), job.distance, self._watch)
        # What the filter costs does not depend on how long a robot takes to react.
        guard = SafetySettings(HARDWARE.footprint.size, max_axis_speed=HARDWARE.drive.max_axis_speed)
        self._controller = SafetyFilter(_Noting(policy, self._watch), guard)

    def step(self, moment: Moment) -> list[float]:
        """Parse a turn, read by read as it arrives, and command; return the time of every stage and of all [s]."""
        self._watch.noted.clear()
        self._watch()
        for read in moment.reads:
            self._time += LD20.period / len(moment.reads)
            self._assembler.add(self._parser.feed(read), self._time)
        self._watch()
        self._controller.command(moment.view)
        self._watch()
        noted = self._watch.noted
        return [*(later - earlier for earlier, later in itertools.pairwise(noted)), noted[-1] - noted[0]]


def peak_memory() -> int:
    """Most resident memory of this process so far [bytes]."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def _quantiles(steps: list[list[float]]) -> dict[str, dict[str, float]]:
    """Return quantiles of every stage [s]."""
    quantiles = np.quantile(steps, [0.5, 0.95, 0.99, 1.0], axis=0).T.tolist()
    labels = ("median", "p95", "p99", "max")
    return {name: dict(zip(labels, each, strict=True)) for name, each in zip(STAGES, quantiles, strict=True)}


def measure(job: Job, moments: Sequence[Moment]) -> dict[str, Any]:
    """Start a robot and take its steps; return times [s] and memory [bytes]."""
    turns = itertools.cycle(moments)
    before = time.monotonic()
    robot = Robot(job, moments[0].view.scans.config)
    loaded = time.monotonic()
    robot.step(next(turns))
    ready = time.monotonic()
    start = {"import": _IMPORTED - job.began, "load": loaded - before, "first": ready - loaded}
    found: dict[str, Any] = {"start": start | {"all": sum(start.values())}}
    if job.seconds == 0:
        return found
    warm = []
    while time.monotonic() < ready + job.seconds:
        warm.append(robot.step(next(turns)))
    found["peak_memory"] = peak_memory()
    swept = np.zeros(_SWEPT, dtype=np.uint8)
    cold = []
    for _ in range(_COLD_STEPS):
        swept += 1
        time.sleep(_PAUSE)
        cold.append(robot.step(next(turns)))
    found["steps"] = {"warm": len(warm), "cold": len(cold)}
    found["seconds"] = {"warm": _quantiles(warm), "cold": _quantiles(cold)}
    return found


if __name__ == "__main__":
    with limit_threads(1):
        sys.stdout.write(json.dumps(measure(Job(**json.loads(sys.argv[2])), load_moments(Path(sys.argv[1])))))
