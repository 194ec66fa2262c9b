"""Whether a robot's computer keeps up: the work of ``triform bench``."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from triform.control import POLICY, ControllerSpec
from triform.evaluation.scenario import Scenario
from triform.limits import LARGEST_SEED, require_at_most
from triform.report.listener import SILENT, Listener
from triform.report.output import prepare_file, write_json
from triform.threads import usable_threads
from triform.timing.robot_step import Job, save_moments
from triform.timing.step_time import record_views, single_views
from triform.types import TriformError, convert_fields, require

_PACKAGES = ("triform", "numpy", "numba", "llvmlite", "onnxruntime", "pyserial")
#: Read by the libraries below us; a policy runs on one thread whatever they say.
_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "NUMBA_CPU_NAME")
_STAGES = {
    "parse": "packets of one turn of an LD20 to a scan",
    "map": "scan to packed map",
    "policy": "map to command",
    "guard": "command to what the scan allows",
    "all": "all of these",
}
_STARTS = {
    "import": "Python and imports",
    "load": "policy loaded",
    "first": "first command",
    "all": "together",
}


@dataclass(frozen=True)
class BenchConfig:
    """Settings of a look at how fast this computer is.

    Attributes:
        controller: Policy to time, such as policy or policy:WEIGHTS.
        distance: Prescribed neighbour distance d* [m].
        rate: Commands per second that the robot is to give [Hz].
        seconds: How long to take steps one after the other [s].
        seed: Of the simulated run whose scans are used.
        json: Where to write what was measured.
    """

    controller: ControllerSpec = POLICY
    distance: float = 1.0
    rate: float = 8.0
    seconds: float = 10.0
    seed: int = 7
    json: Path | None = None

    def __post_init__(self) -> None:
        convert_fields(self)
        require(
            self.controller.name == "policy",
            f"controller is {self.controller.label!r}; the bench times a policy, such as policy or policy:paper",
        )
        require(0 < self.rate < math.inf, f"rate is {self.rate} Hz; it must be positive and finite")
        require(0 < self.seconds < math.inf, f"seconds is {self.seconds}; it must be positive and finite")
        require(self.seed >= 0, f"seed is {self.seed}; it must not be negative")
        for name, most in (("rate", 10_000), ("seconds", 86_400), ("seed", LARGEST_SEED)):
            require_at_most(name, getattr(self, name), most)
        _ = self.scenario

    @property
    def scenario(self) -> Scenario:
        """Where the scans come from: robots with the hardware profile."""
        return Scenario(profile="hardware", distance=self.distance)


def run_bench(config: BenchConfig, listener: Listener = SILENT) -> dict[str, Any]:
    """Time one robot's way from scan to command on this computer, and say whether it keeps up.

    The steps are taken in a process of its own, which holds nothing but what a robot needs. It is started twice: with
    no compiled kernels, and with those that the first one kept.

    Args:
        config: What to time.
        listener: Hears of progress, tables and the verdict.

    Returns:
        What was measured, plain JSON values; times in seconds.

    Raises:
        TriformError: The weights cannot be used, the file cannot be written, or the process failed.
    """
    if config.json is not None:
        prepare_file(config.json)
    config.scenario.make_controller(config.controller)
    with tempfile.TemporaryDirectory(prefix="triform-bench-") as name:
        folder = Path(name)
        with listener.progress("recording scans of a simulated team", 1):
            save_moments(folder / "scans.npz", single_views(record_views(config.scenario, config.seed)))
        with listener.progress("starting without compiled kernels", 1):
            compiled = _measure(config, folder, 0.0)
        with listener.progress(f"taking steps for {config.seconds:g} s", 1):
            found = _measure(config, folder, config.seconds)
    verdict, keeps_up = judge(found["seconds"]["cold"], config.rate)
    result = {
        "config": asdict(config),
        "machine": describe_machine(),
        "start_compiling": compiled["start"],
        **found,
        "keeps_up": keeps_up,
    }
    _show(result, verdict, listener)
    if config.json is not None:
        write_json(config.json, result)
        listener.say(f"wrote {config.json}")
    return result


def _measure(config: BenchConfig, folder: Path, seconds: float) -> dict[str, Any]:
    """Let another process do the steps; its kernels are kept in ``folder``."""
    job = Job(time.monotonic(), config.controller.weights, config.distance, seconds)
    command = [sys.executable, "-m", "triform.timing.robot_step", f"{folder}/scans.npz", json.dumps(asdict(job))]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "kernels")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise TriformError(f"the process that takes the steps failed with status {done.returncode}: {last}")
    return dict(json.loads(done.stdout))


def judge(cold: dict[str, dict[str, float]], rate: float) -> tuple[list[str], bool]:
    """Return in sentences, and as a truth value, whether every stage, and all of them, keep up with ``rate`` [Hz].

    Args:
        cold: Quantiles of the stages with cold caches [s].
        rate: Commands per second [Hz].
    """
    period = 1 / rate
    slow = [name for name, seconds in cold.items() if seconds["p99"] > period]
    if slow:
        return [
            f"{_STAGES[name]}: CANNOT keep up with {rate:g} Hz: 1 step of 100 takes {1e3 * cold[name]['p99']:.1f} ms "
            f"or more of {1e3 * period:.1f} ms"
            for name in slow
        ], False
    share = cold["all"]["p99"] / period
    return [
        f"keeps up with {rate:g} Hz: 99 of 100 steps take {1e3 * cold['all']['p99']:.2f} ms or less with cold caches, "
        f"{100 * share:.1f} % of a control period of {1e3 * period:.1f} ms"
    ], True


def describe_machine() -> dict[str, Any]:
    """Return processor, system, versions and what decides about threads, plain JSON values."""
    return {
        "processor": _processor(),
        "architecture": platform.machine(),
        "system": f"{platform.system()} {platform.release()}",
        "processors": os.cpu_count(),
        "processors_usable": usable_threads(),
        "threads": 1,
        "environment": {name: os.environ[name] for name in _VARIABLES if name in os.environ},
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in _PACKAGES},
    }


def _processor() -> str:
    """Name of the processor, and of the board where the firmware names one, as on Arm."""
    board = Path("/proc/device-tree/model")
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    fields = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    parts = [board.read_text(encoding="utf-8").strip("\0 \n")] if board.exists() else []
    if "model name" in fields:
        parts.append(fields["model name"])
    elif "CPU part" in fields:
        parts.append(f"CPU implementer {fields.get('CPU implementer', '?')}, part {fields['CPU part']}")
    return ", ".join(parts) or "unknown"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _show(result: dict[str, Any], verdict: list[str], listener: Listener) -> None:
    machine, steps = result["machine"], result["steps"]
    versions = ", ".join(f"{name} {found}" for name, found in machine["packages"].items())
    listener.say(f"{machine['processor']}, {machine['architecture']}, one thread; {versions}")
    starts = [
        [what, f"{result['start_compiling'][name]:.2f}", f"{result['start'][name]:.2f}"]
        for name, what in _STARTS.items()
    ]
    listener.table("start, in s", ["", "kernels compiled", "kernels kept"], starts)
    rows = [
        [caches, _STAGES[name], *(f"{1e3 * value:.3f}" for value in quantiles.values())]
        for caches in ("warm", "cold")
        for name, quantiles in result["seconds"][caches].items()
    ]
    title = f"time, in ms: {steps['warm']} steps one after the other, {steps['cold']} with cold caches"
    listener.table(title, ["caches", "stage", "50 %", "95 %", "99 %", "max"], rows)
    listener.say(f"peak memory {result['peak_memory'] / 2**20:.0f} MiB")
    for sentence in verdict:
        listener.say(sentence)
