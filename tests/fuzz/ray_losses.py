"""Ray that is lost: one sentence within ten seconds, exit 1, and what was finished kept.

    python -m tests.fuzz.ray_losses

Starts ``triform collect --engine ray`` again and again, kills one of Ray's processes while it starts and while it
works, and finishes the data set on threads afterwards. Needs Linux, where processes are found by name.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path

from tests.fuzz.trials import options

#: Longest time from the kill to the end of the command [s].
LIMIT = 10.0
COLLECT = ["collect", "--preset", "quick", "--runs", "600", "--placements", "200"]


#: Which process is lost, when, and by which signal: a worker has work from the beginning.
LOSSES = (
    *product(("gcs_server", "raylet"), ("start", "work"), (signal.SIGKILL,)),
    ("gcs_server", "work", signal.SIGTERM),
    ("raylet", "work", signal.SIGTERM),
    ("ray::triform_item", "work", signal.SIGKILL),
)


def descendants(pid: int) -> Iterator[tuple[int, str]]:
    """Number and command of every process below ``pid``."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            name, _, rest = (folder / "stat").read_text().partition("(")[2].rpartition(")")
            command = (folder / "cmdline").read_bytes().split(b"\0")[0].decode()
        except OSError:
            continue
        if rest.split()[0] != "Z":
            parents[int(folder.name)] = int(rest.split()[1]), command or name
    todo = [pid]
    while todo:
        parent = todo.pop()
        for child, (of, name) in parents.items():
            if of == parent:
                todo.append(child)
                yield child, name.rsplit("/", 1)[-1]


def lose(process: str, when: str, by: signal.Signals, folder: Path) -> str:
    """Send a signal to ``process`` of a command's Ray; returns what went wrong then."""
    out = folder / "data"
    command = [sys.executable, "-m", "triform", *COLLECT, "--out", str(out)]
    child = subprocess.Popen([*command, "--engine", "ray", "--workers", "2"], stderr=subprocess.PIPE, text=True)
    while when == "work" and child.poll() is None and len(list(out.glob("shards/shard-*.parquet"))) < 2:
        time.sleep(0.02)
    found: list[int] = []
    while not found and child.poll() is None:
        found = [pid for pid, name in descendants(child.pid) if name.startswith(process)]
    for pid in found[:1]:
        os.kill(pid, by)
    began = time.monotonic()
    _, errors = child.communicate()
    seconds = time.monotonic() - began
    print(
        f"{process} lost during {when} by {by.name}: exit {child.returncode} after {seconds:.1f} s: {errors.strip()}",
        flush=True,
    )
    kept = {path.name: path.read_bytes() for path in out.glob("shards/shard-*.parquet")}
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0 or any((out / "shards" / name).read_bytes() != data for name, data in kept.items()):
        return f"the data set could not be finished: {done.stderr}"
    if (child.returncode, errors) == (0, ""):
        return ""
    if process.startswith("ray::"):
        return "a lost worker ended the command"
    if child.returncode != 1 or not errors.startswith("triform: ") or len(errors.strip().splitlines()) != 1:
        return "not one sentence and exit 1"
    return f"{seconds:.1f} s" if seconds > LIMIT else ""


def run(seconds: float) -> int:
    """Lose each process at each time, again and again until the time is over; returns the failures."""
    began, tried, failed = time.monotonic(), 0, 0
    while tried == 0 or time.monotonic() - began < seconds:
        for process, when, by in LOSSES:
            with tempfile.TemporaryDirectory() as folder:
                wrong = lose(process, when, by, Path(folder))
            tried, failed = tried + 1, failed + (wrong != "")
            if wrong:
                print(f"{process} lost during {when} by {by.name}: {wrong}", flush=True)
    print(f"ray losses: {tried} tried, {failed} failed")
    return failed


if __name__ == "__main__":
    sys.exit(run(options(__doc__ or "", tries=0, seconds=0.0).seconds) > 0)
