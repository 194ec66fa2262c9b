"""Campaigns: many trials from seeds, a count of those that failed, and the first of them."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

#: One trial; returns what went wrong, or an empty text.
Trial = Callable[[np.random.Generator], str]


def campaign(name: str, trial: Trial, tries: int, seconds: float = np.inf, seed: int = 0) -> int:
    """Run trials until there were enough or the time is over; print failures and one last line of counts.

    Args:
        name: What is tried, for the last line.
        trial: Does one trial, a function of its generator alone.
        tries: Most trials.
        seconds: Longest time [s].
        seed: Decides all trials.

    Returns:
        Trials that failed.
    """
    began, tried, failed = time.monotonic(), 0, 0
    while tried < tries and time.monotonic() - began < seconds:
        wrong = trial(np.random.default_rng([seed, tried]))
        if wrong:
            failed += 1
            print(f"{name}: trial {tried} of seed {seed}: {wrong}")
        tried += 1
    print(f"{name}: {tried} tried, {failed} failed")
    return failed


def flip(data: bytes, rng: np.random.Generator) -> bytes:
    """``data`` with one bit of it flipped."""
    flipped = bytearray(data)
    flipped[rng.integers(len(flipped))] ^= 1 << int(rng.integers(8))
    return bytes(flipped)


def options(description: str, tries: int, seconds: float = np.inf) -> argparse.Namespace:
    """The options of a campaign's command line: ``tries``, ``seconds`` and ``seed``."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--tries", type=int, default=tries)
    parser.add_argument("--seconds", type=float, default=seconds)
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()
