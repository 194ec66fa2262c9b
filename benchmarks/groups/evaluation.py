"""Wall time of ``triform evaluate`` on Table I of the paper, through the command line."""

from __future__ import annotations

import functools
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.report import Aim, Row
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Spread, call_seconds

#: Team sizes, runs of each, and length of a run [s]: Table I, and what a quick look takes.
_TABLE_I = ((5, 7, 9, 11, 13), 100, 40.0)
_TINY = ((5,), 1, 5.0)


def measure(settings: Settings, watch: Watch) -> Iterator[Row]:
    """Both shipped policies in turns."""
    what = _TINY if settings.quick else _TABLE_I
    sizes, runs, duration = what
    rounds = 1 if settings.quick else 3
    weights = {"large": 240.0, "near": 90.0}
    seconds = {name: np.empty(rounds) for name in weights}
    with TemporaryDirectory() as folder:
        results = {name: Path(folder) / f"{name}.json" for name in weights}
        # Compiles the kernels, which is done once in the life of an installation.
        _evaluate("near", _TINY, results["near"], settings.cores)
        for turn in range(rounds):
            for k, name in enumerate(weights):
                watch(f"triform evaluate --weights {name}", turn * len(weights) + k, rounds * len(weights))
                command = functools.partial(_evaluate, name, what, results[name], settings.cores)
                seconds[name][turn] = call_seconds(command)
        steps = 10 * duration * runs * sum(sizes)
        for name, aim in weights.items():
            success = [each["success"] for each in json.loads(results[name].read_text())["results"]]
            yield Row(
                f"triform evaluate --weights {name}, {len(sizes)} sizes x {runs} runs x {duration:g} s, "
                f"{settings.cores} cores",
                Spread.of(seconds[name], "s"),
                Aim("<=", aim),
                {"a robot's step": Spread.of(1e6 * seconds[name] / steps, "µs")},
                f"The whole command, {steps:,.0f} steps of robots; success {_percents(success)}.",
            )


def _evaluate(weights: str, what: tuple[tuple[int, ...], int, float], result: Path, cores: int) -> None:
    sizes, runs, duration = what
    command = [sys.executable, "-m", "triform.cli", "evaluate", "--weights", weights, "--threads", str(cores)]
    command += ["--robots", *map(str, sizes), "--runs", str(runs), "--duration", str(duration), "--json", str(result)]
    subprocess.run(command, check=True, capture_output=True, text=True)


def _percents(shares: list[float | None]) -> str:
    return "/".join("-" if share is None else f"{100 * share:.0f}" for share in shares) + " %"
