"""Damaged views and blind LiDARs: finite commands or a sentence, and wheels that turn only while the robot sees.

python -m tests.fuzz.sight --tries 5000 --seed 0
"""

from __future__ import annotations

import functools
import math
import sys
import time
from typing import Any

import numpy as np

from tests.fuzz.trials import campaign, options
from triform.control import CONTROLLERS, SafetyFilter, make_controller
from triform.robots.laser_scan import Turn
from triform.robots.real import RealRobot
from triform.simulation import Drive, Footprint, Mounting, Placement
from triform.types import Controller, FloatArray, PrivilegedView, Scan, ScanConfig, TriformError

SCAN = ScanConfig(rays=450)
ROBOTS = 3
ODD = (math.nan, math.inf, -math.inf, 1e308, -1e308, 1e200, 1e9, 1e6, -1e6, 1e5, 0.0, -0.0, 5e-324)
FEW = ScanConfig(rays=24, range_min=0.05)
#: What a turn may show everywhere, but for a few rays.
FACES = (math.inf, math.nan, -math.inf, 0.1, 1.0, 5.0)


@functools.cache
def controller_called(name: str) -> Controller[Any]:
    """The controller of this name behind the safety filter."""
    return SafetyFilter(make_controller(name))


def spoil(values: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Put up to three odd numbers into an array."""
    for place in rng.integers(values.size, size=rng.integers(4)):
        values.flat[place] = rng.choice(ODD)
    return values


def view(rng: np.random.Generator) -> str:
    """Any controller and a view with odd numbers: its commands are finite, or it is refused for a reason."""
    returns = rng.random((1, ROBOTS, SCAN.rays)) < rng.choice([0.02, 0.3])
    ranges = np.where(returns, rng.uniform(0.1, 2.0, returns.shape), rng.choice([np.inf, np.nan]))
    poses, noise = rng.uniform(-1.5, 1.5, (1, ROBOTS, 3)), rng.standard_normal((1, ROBOTS, 2))
    odometry = rng.uniform(-0.2, 0.2, (1, ROBOTS, 3))
    given = [spoil(values, rng) for values in (ranges, poses, noise, odometry)]
    name = rng.choice(CONTROLLERS)
    try:
        scans, active = Scan(given[0], SCAN), np.ones((1, ROBOTS), bool)
        seen = PrivilegedView(scans, active, 2.0, given[1], noise=given[2], odometry=given[3])
        commands = controller_called(str(name)).command(seen)
    except TriformError as error:
        plausible = all((np.abs(values) <= 1e6).all() for values in given[1:])
        return f"{name} refused a plausible view: {error}" if plausible else ""
    return "" if np.isfinite(commands).all() else f"{name} gave {commands.tolist()}"


class Eyes:
    """A LiDAR that hands out what it is given, and wheels that count."""

    scan = FEW

    def __init__(self) -> None:
        """Begin without a turn."""
        self.turn: Turn | None = None
        self.command = np.zeros(3)

    def latest(self) -> Turn | None:
        """The newest turn."""
        return self.turn

    def drive(self, command: FloatArray) -> None:
        """Take a command."""
        self.command = command

    def stop(self) -> None:
        """Stand."""

    def odometry(self, at: float) -> None:
        """Not known."""


def sees(ranges: FloatArray, mounting: Mounting, footprint: Footprint) -> bool:
    """Whether a turn shows anything but the robot itself and most is known, ray by ray; lengths with 1 cm of margin."""
    returned = unknown = looked = 0
    for angle, value in zip(FEW.angles, ranges, strict=True):
        if any((math.degrees(angle) - a) % 360 <= (b - a) % 360 for a, b in mounting.blind_sectors):
            continue
        looked += 1
        if value == math.inf:
            continue
        distance = FEW.range_min if value == -math.inf else value
        x, y = mounting.x + distance * math.cos(angle), mounting.y + distance * math.sin(angle)
        own = abs(x) <= footprint.half_length + 0.01 and abs(y) <= footprint.half_width + 0.01
        if own or math.isnan(value):
            unknown += 1
        else:
            returned += 1
    return returned > 0 and unknown <= looked / 2


def blindness(rng: np.random.Generator) -> str:
    """Random turns of a LiDAR mounted anywhere: the robot drives by how long ago it has seen, and says once why not."""
    sectors = ((170.0, 190.0),) if rng.random() < 0.3 else ()
    mounting = Mounting(*rng.uniform(-0.1, 0.1, 2) * (rng.random() < 0.5), blind_sectors=sectors)
    footprint, eyes, said = Footprint.box(0.32, 0.24), Eyes(), list[str]()
    placement = Placement(FEW, mounting, footprint.body)
    robot = RealRobot(eyes, eyes, 1e-5, 1, Drive(), placement=placement, scan_timeout=60.0, warn=said.append)
    blind, spells = 3, 0
    began = time.monotonic()
    for index in range(rng.integers(1, 15)):
        ranges = np.full(FEW.rays, rng.choice(FACES), np.float32)
        some = rng.integers(FEW.rays, size=rng.integers(FEW.rays))
        ranges[some] = rng.choice(FACES, len(some))
        eyes.turn = Turn(ranges, began + 1e-6 * index, began + 1e-6 * (index + 1))
        before = blind
        blind = 0 if sees(ranges, mounting, footprint) else blind + 1
        spells += blind >= 3 and (before < 3 or index == 0)
        robot.observe()
        robot.apply(np.full((1, 1, 3), 0.1), 1e-5)
        if not math.isclose(eyes.command[0], 0.1 * max(0.0, 1 - blind / 3), abs_tol=1e-9):
            return f"drives {eyes.command[0]} after {blind} blind turns, the last {ranges.tolist()}, {mounting}"
    told = sum("until it sees again" in sentence for sentence in said)
    itself = sum("own outline" in sentence for sentence in said)
    return "" if told == spells and itself <= 1 else f"{spells} blind spells, said {said}"


def trial(rng: np.random.Generator) -> str:
    """Any of these trials."""
    kind = (view, blindness)[rng.integers(2)]
    try:
        return kind(rng)
    except Exception as error:  # noqa: BLE001 - what is looked for
        return f"{kind.__name__}: {type(error).__name__}: {error}"


def run(tries: int, seconds: float = np.inf, seed: int = 0) -> int:
    """Try ``tries`` views and LiDARs; returns those that failed."""
    return campaign("sight", trial, tries, seconds, seed)


if __name__ == "__main__":
    given = options(__doc__ or "", tries=5_000)
    sys.exit(run(given.tries, given.seconds, given.seed) > 0)
