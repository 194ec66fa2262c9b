"""What is measured on: starts, and what robots see while they form up."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.settings import Settings
from triform.control import drive, make_controller
from triform.simulation import World, get_profile, sample_starts
from triform.types import FloatArray, PrivilegedView, Scan

SEED = 0
#: Robots per square metre; that of the protocol's starts of many robots.
_DENSITY = 13 / 25


def start_poses(robots: int, worlds: int) -> FloatArray:
    """The protocol's starts, shape (worlds, robots, 3) [m, m, rad]."""
    return sample_starts(robots, worlds, SEED)


def closed_loop_scans(robots: int, settings: Settings) -> Scan:
    """Scans during runs of the shipped policy `near`, shape (moments, robots, R).

    Two runs of 40 s, looked at every 2 s: from random starts to finished formations.
    """
    duration, every = (2.0, 10) if settings.quick else (40.0, 20)
    world = World(start_poses(robots, 2), get_profile("ideal"))
    seen: list[FloatArray] = []
    step = 0

    def look(view: PrivilegedView, _commands: FloatArray) -> None:
        nonlocal step
        if step % every == 0:
            seen.append(view.scans.ranges.copy())
        step += 1

    drive(world, make_controller("policy:near", threads=1), duration, look)
    return Scan(np.concatenate(seen), world.profile.lidar.scan)


def crowd(robots: int) -> FloatArray:
    """One world of any number of robots, as densely as the protocol's starts, shape (1, robots, 3) [m, m, rad].

    A square lattice, each robot moved by up to a fifth of its spacing: no search for free places, so that there is no
    limit to the number.
    """
    rng = np.random.default_rng(np.random.SeedSequence([robots, SEED]))
    columns = math.ceil(math.sqrt(robots))
    spacing = 1 / math.sqrt(_DENSITY)
    index = np.arange(robots)
    lattice = spacing * np.stack([index // columns, index % columns], axis=1)
    positions = lattice + spacing * rng.uniform(-0.2, 0.2, lattice.shape)
    headings = rng.uniform(-np.pi, np.pi, (robots, 1))
    return np.concatenate([positions, headings], axis=1)[None]
