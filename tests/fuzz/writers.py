"""Several processes that write one file: each read is whole, no write is refused, and no leftover stays.

    python -m tests.fuzz.writers --seconds 60 --seed 0

One of three writers is killed and begun again all the time. Systems without ``fork`` cannot run it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import tempfile
import time
from itertools import count
from multiprocessing.queues import SimpleQueue
from pathlib import Path

import numpy as np

from tests.fuzz.trials import options
from triform.files import write_atomically
from triform.types import TriformError


def content(writer: int, number: int) -> bytes:
    """What a writer writes in its turn: one byte throughout, in different lengths."""
    return bytes([10 * writer + number % 10]) * (20_000 + 7_000 * (number % 5))


def write(path: Path, writer: int, seconds: float, said: SimpleQueue[tuple[int, str]]) -> None:
    """Write for a while, and say how often, and what was refused."""
    until, writes, refused = time.monotonic() + seconds, 0, ""
    for number in count():
        if time.monotonic() > until:
            break
        try:
            write_atomically(path, content(writer, number))
        except TriformError as error:
            refused = str(error)
        writes += 1
    said.put((writes, refused))


def run(seconds: float, seed: int = 0) -> int:
    """Write and read for ``seconds``; returns what went wrong: torn reads, refused writes and leftovers."""
    fork = multiprocessing.get_context("fork")
    rng, whole = np.random.default_rng(seed), {content(w, n) for w in range(3) for n in range(10)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        write_atomically(path, content(0, 0))
        said = fork.SimpleQueue()
        writers = [fork.Process(target=write, args=(path, number, seconds, said)) for number in range(2)]
        for each in writers:
            each.start()
        until, reads, torn, kills = time.monotonic() + seconds, 0, 0, 0
        while time.monotonic() < until:
            killed = fork.Process(target=write, args=(path, 2, seconds, fork.SimpleQueue()))
            killed.start()
            stop = time.monotonic() + rng.random() * 0.05
            while time.monotonic() < stop:
                torn += path.read_bytes() not in whole
                reads += 1
            assert killed.pid is not None
            os.kill(killed.pid, signal.SIGKILL)
            killed.join()
            kills += 1
        results = [said.get() for _ in writers]
        for each in writers:
            each.join()
        write_atomically(path, content(0, 0))
        left = [each.name for each in Path(folder).iterdir() if each != path]
    refused = [text for _, text in results if text]
    failed = torn + len(refused) + len(left)
    for text in (*refused, *left):
        print(f"writers: refused or left behind: {text}")
    writes = sum(each for each, _ in results)
    print(f"writers: {reads} reads during {writes} writes and {kills} kills tried, {failed} failed")
    return failed


if __name__ == "__main__":
    given = options(__doc__ or "", tries=0, seconds=60.0)
    sys.exit(run(given.seconds, given.seed) > 0)
