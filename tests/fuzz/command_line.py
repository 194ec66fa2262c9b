"""Random command lines: each ends soon, in a sentence or in a result, and never in a traceback.

    python -m tests.fuzz.command_line --tries 400 --seed 0

A worker process calls ``triform.cli.main`` with one list of arguments after the other, in a folder with good, empty and
hostile files. A call begins with options that make its work small, and up to three options get values of the pools
below. It passes if it ends within the time limit, with exit status 0, 1 or 2, and says why if it is not 0. Commands
that go on for long by nature are interrupted and must then end in a sentence. The last line counts calls.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import select
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

#: How a call of each command begins, so that its work is small.
SMALL = {
    "demo": "--robots 3 --duration 5 --controller expert",
    "gallery": "--threads 1",
    "show": "",
    "view": "--html page.html --robots 3 --duration 5 --controller expert",
    "evaluate": "--robots 3 --runs 1 --duration 5 --controller expert --threads 1",
    "compare": "--robots 3 --hardware-robots 4 --runs 1 --large-runs 1 --duration 5 --controllers expert --threads 1",
    "conditions": "--which latency --robots 3 --runs 1 --failures 1 --duration 5 --controller expert --threads 1",
    "ablate": "--robots 3 --runs 1 --duration 5 --threads 1",
    "reproduce": "fig2 --runs 1 --duration 5 --controller expert --threads 1",
    "measure": "take.csv",
    "collect": "--out data --runs 1 --steps 2 --placements 2 --workers 1",
    "train": "--out run --preset quick --maps 64",
    "export": "empty",
    "drive": "--lidar nowhere --address 127.0.0.1",
    "emulate": "--duration 0.2 --robots 1",
    "bench": "--seconds 0.1",
}
#: Commands that work until they are interrupted, or for minutes whatever their options are.
LONG = ("gallery", "train", "drive", "emulate", "bench")
#: How often each command is called; those that load much or start processes are called less often.
_WEIGHTS = dict.fromkeys(SMALL, 1.0) | dict.fromkeys(
    ("train", "bench", "reproduce", "compare", "conditions", "gallery"), 0.3
)

NUMBERS = (
    "0", "1", "2", "3", "5", "-1", "0.5", "-0.5", "1e-300", "1e308", "1e400", "nan", "inf", "-inf", "1e7", "0x10",
    "1_0", "\u0661", "1000000000", "4294967296", "9223372036854775807", "9223372036854775808", "1" + 30 * "0",
    5000 * "9", "",
)  # fmt: skip
TEXTS = (
    "", "[/]", "[bold]x", ":smile:", "\x1b[31m", "\udcff", "a\nb", "\u00e9", "-", "--", "none", "expert", "policy",
    "policy:", "policy:empty", "policy:damaged", "policy:nowhere", "code.py:Thing", "empty.py:Thing", "json:loads",
    "ideal", "hardware", "deep.toml", "wrong.toml", "open", "pillars", "join", "join@", "join@1e999", "push@-1", "ep",
    "circle:nan", "box:1x", "circle:1e300", "local", "ray", "127.0.0.1", "256.1.1.1", "cpu", "cuda", "abacus", "all",
    "latency",
)  # fmt: skip
PATHS = (
    "", ".", "null", "full", "/proc/self/mem", "file", "file/x", "empty", "new", "new/a/b", "a[/]b/x.json",
    "x\x1b[31m.json", "x\udcff.json", "deep.json", "claims.npy", "zero.npy", "objects.npy", "starts.npy", "starts.csv",
    "garbage.csv", "take.csv", "take.npy", "garbage.parquet", "damaged", 300 * "n", 3000 * "n/",
)  # fmt: skip


@dataclass(frozen=True)
class Answer:
    """How a call ended.

    Attributes:
        status: Its exit status; ``None`` if an exception left it or it never ended.
        errors: What it wrote to standard error, or the traceback.
        seconds: How long it took [s].
        interrupted: Whether it had to be interrupted.
    """

    status: int | None
    errors: str
    seconds: float
    interrupted: bool


@cache
def options_of(command: str) -> dict[str, Any]:
    """Return the types of a command's options, flat, by their names on the command line."""
    from triform.cli import COMMANDS

    found: dict[str, Any] = {}

    def add(kind: Any) -> None:
        hints = get_type_hints(kind)
        for each in fields(kind):
            nested = hints[each.name]
            if is_dataclass(nested) and not hasattr(nested, "parse"):
                add(nested)
            else:
                found["--" + each.name.replace("_", "-")] = nested

    add(COMMANDS[command].load())
    return found


def draw_call(rng: np.random.Generator) -> list[str]:
    """Return the arguments of a random call."""
    names = list(SMALL)
    weights = np.array([_WEIGHTS[name] for name in names])
    command = str(rng.choice(names, p=weights / weights.sum()))
    words = [command, *shlex.split(SMALL[command])]
    options = options_of(command)
    for _ in range(int(rng.integers(4))):
        name = str(rng.choice(list(options)))
        kind = options[name]
        if kind is bool:
            words.append(name if rng.random() < 0.5 else name.replace("--", "--no-", 1))
            continue
        words.append(name)
        count = 1
        if get_origin(kind) is tuple or any(get_origin(part) is tuple for part in get_args(kind)):
            count = int(rng.integers(4))
        for _ in range(count):
            kinds = {kind, *get_args(kind)}
            pool = NUMBERS if kinds & {int, float} else PATHS if Path in kinds else TEXTS
            if rng.random() < 0.1:
                pool = NUMBERS + TEXTS + PATHS
            words.append(pool[rng.integers(len(pool))])
    if rng.random() < 0.1:
        words.insert(int(rng.integers(1, len(words) + 1)), TEXTS[rng.integers(len(TEXTS))])
    return words


def fill(folder: Path) -> None:
    """Write the files that calls name."""
    (folder / "empty").mkdir()
    (folder / "a[/]b").mkdir(parents=True)
    (folder / "damaged").mkdir()
    (folder / "damaged" / "model.json").write_text(100_000 * "[")
    (folder / "damaged" / "model.safetensors").write_bytes(b"\xff" * 64)
    (folder / "file").touch()
    (folder / "null").symlink_to("/dev/null")
    (folder / "full").symlink_to("/dev/full")
    (folder / "empty.py").touch()
    (folder / "code.py").write_text("class Thing:\n    pass\n")
    (folder / "deep.json").write_text(100_000 * "[")
    (folder / "deep.toml").write_text("x = " + 100_000 * "[")
    (folder / "wrong.toml").write_text("latency = -1\n")
    for name, shape in (("claims.npy", (10**9, 10**6, 3)), ("zero.npy", (10**9, 0, 0, 3))):
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
        (folder / name).write_bytes(header.getvalue())
    np.save(folder / "objects.npy", np.array([{}]), allow_pickle=True)
    np.save(folder / "take.npy", np.zeros((80, 3, 3)) + np.arange(3)[:, None])
    rows = [(run, robot, 0.9 * robot, run, 0.0) for run in range(2) for robot in range(3)]
    np.save(folder / "starts.npy", np.array(rows, dtype=np.float64))
    text = "run,robot,x,y,heading\n" + "\n".join(",".join(map(str, row)) for row in rows)
    (folder / "starts.csv").write_text(text)
    (folder / "garbage.csv").write_bytes(bytes(range(256)))
    (folder / "garbage.parquet").write_bytes(b"PAR1" + bytes(64) + b"PAR1")
    times = [f"{0.1 * step},{robot},{robot},{step % 2},0" for step in range(80) for robot in range(3)]
    (folder / "take.csv").write_text("time,robot,x,y,heading\n" + "\n".join(times))


def serve() -> None:
    """Make the calls that come on standard input, one JSON list a line, and answer each with a line of JSON."""
    from triform.cli import main

    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    for line in sys.stdin:
        words = json.loads(line)
        errors = io.StringIO()
        output = Path("/dev/full").open("w") if len(words) % 20 == 0 else io.StringIO()  # noqa: SIM115
        status: int | None
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
            try:
                status = main(words)
            except SystemExit as ended:
                status = ended.code if isinstance(ended.code, int) else 1
            except BaseException:  # noqa: BLE001
                status = None
                errors.write(traceback.format_exc())
        with contextlib.suppress(OSError):
            output.close()
        answers.write(json.dumps([status, errors.getvalue()]) + "\n")
        answers.flush()


class Worker:
    """A process that makes calls in a folder of its own."""

    def __init__(self, limit: float) -> None:
        """Start no process yet; ``limit`` is the time of one call [s]."""
        self._limit = limit
        self._process: subprocess.Popen[str] | None = None

    def call(self, words: list[str], folder: Path) -> Answer:
        """Make one call; a process that does not answer is killed, and the next call starts another."""
        if self._process is None:
            environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "TRIFORM_QUIET": "1"}
            command = [sys.executable, "-m", "tests.fuzz.command_line", "--serve"]
            self._process = subprocess.Popen(
                command, cwd=folder, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                stderr=subprocess.DEVNULL,
            )  # fmt: skip
        process, began = self._process, time.monotonic()
        assert process.stdin is not None
        process.stdin.write(json.dumps(words) + "\n")
        process.stdin.flush()
        answer, interrupted = self._wait(self._limit), False
        # The first Ctrl-C ends a training between two steps, which may wait for kernels; the second acts at once.
        for _ in range(2 if words[0] in LONG else 1):
            if not answer and process.poll() is None:
                interrupted = True
                process.send_signal(signal.SIGINT)
                answer = self._wait(30)
        seconds = time.monotonic() - began
        if not answer:
            self.close()
            return Answer(None, f"the process ended with {process.returncode}, without an answer", seconds, interrupted)
        status, errors = json.loads(answer)
        return Answer(status, errors, seconds, interrupted)

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def _wait(self, seconds: float) -> str:
        assert self._process is not None
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], seconds)
        return self._process.stdout.readline() if ready else ""


def fault(command: str, answer: Answer) -> str:
    """Return what is wrong with an answer; empty if nothing is."""
    if answer.interrupted and command not in LONG:
        return f"took more than {answer.seconds:.0f} s"
    if answer.status not in (0, 1, 2, *((130, 143) if answer.interrupted else ())):
        return f"exit status {answer.status}"
    if "Traceback" in answer.errors:
        return "a traceback"
    if answer.status == 1 and "triform: " not in answer.errors:
        return "no sentence"
    if any(not (each.isprintable() or each == "\n") for each in answer.errors):
        return "characters that steer a terminal"
    return ""


def run(tries: int | None, seconds: float | None, seed: int, limit: float) -> tuple[Counter[Any], list[str]]:
    """Make random calls.

    Args:
        tries: How many; without it, as many as the time allows.
        seconds: For how long [s]; without it, until all are made.
        seed: Of the calls.
        limit: Time of one call [s].

    Returns:
        How many ended with each exit status, and a line for each that failed.
    """
    rng, worker, began = np.random.default_rng(seed), Worker(limit), time.monotonic()
    ends: Counter[Any] = Counter()
    failures = []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        fill(folder)
        try:
            while (tries is None or ends.total() < tries) and (seconds is None or time.monotonic() - began < seconds):
                words = draw_call(rng)
                answer = worker.call(words, folder)
                ends[answer.status] += 1
                wrong = fault(words[0], answer)
                if wrong:
                    call = [word if len(word) < 100 else f"{word[:20]}... ({len(word)})" for word in words]
                    failures.append(f"{wrong}: {call!r}\n{answer.errors[-1500:]}")
        finally:
            worker.close()
    return ends, failures


def main() -> int:
    """Run the campaign and return its exit status."""
    parser = argparse.ArgumentParser(description="Random command lines.")
    parser.add_argument("--tries", type=int)
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=float, default=60.0, help="time of one call [s]")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        serve()
        return 0
    seconds = 60.0 if given.tries is None and given.seconds is None else given.seconds
    ends, failures = run(given.tries, seconds, given.seed, given.limit)
    for each in failures:
        print(each)
    print("exit statuses:", ", ".join(f"{status}: {count}" for status, count in ends.most_common()))
    print(f"command_line: {ends.total()} tried, {len(failures)} failed")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
