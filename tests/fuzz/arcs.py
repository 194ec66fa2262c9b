"""Campaign: rolling robots that want to collide never do, behind the safety filter.

    python -m tests.fuzz.arcs --seconds 60 --seed 0

Every trial draws a base (speeds, accelerations, lag, track, whether it reverses), an outline, a LiDAR with its errors
and its latency, a start, and speeds and turn rates that change at random, half of them straight at the middle of all.
"""

from __future__ import annotations

import sys

import numpy as np

from tests.fuzz.trials import campaign, options
from triform.evaluation.scenario import Scenario
from triform.simulation import Composition, Drive, Footprint, LidarConfig, Profile, World, constant_noise, sample_starts
from triform.types import FloatArray, PrivilegedView, ScanConfig


class Reckless:
    """Speeds and turn rates at random, each held for a while, half of them straight at the middle of all."""

    privileged = True

    def __init__(self, seed: int, hold: float) -> None:
        self.description = {"name": "reckless"}
        self._seed, self._hold = seed, hold

    def command(self, view: PrivilegedView) -> FloatArray:
        rng = np.random.default_rng([self._seed, int(view.time / self._hold)])
        shape = view.active.shape
        speeds, turns = rng.choice([-1.0, 0.5, 1.0], shape), rng.choice([-4.0, -1.0, 0.0, 1.0, 4.0], shape)
        rolls = np.stack([speeds, np.zeros(shape), turns], axis=-1)
        ahead = view.poses[..., :2].mean(axis=1, keepdims=True) - view.poses[..., :2]
        angle = np.arctan2(ahead[..., 1], ahead[..., 0]) - view.poses[..., 2]
        crush = np.stack([np.cos(angle), np.sin(angle), np.zeros(shape)], axis=-1)
        return np.where(rng.random(shape)[..., None] < 0.5, rolls, crush)


def draw_robot(rng: np.random.Generator) -> Profile:
    """A robot with a differential base, of the sizes and speeds of those that are sold."""
    rolling = bool(rng.random() < 0.7)
    drive = Drive(
        max_speed=rng.uniform(0.1, 0.5),
        max_turn_rate=rng.uniform(1.0, 4.0),
        max_acceleration=rng.choice([np.inf, rng.uniform(0.5, 2.0)]),
        max_turn_acceleration=rng.choice([np.inf, rng.uniform(4.0, 15.0)]),
        lag=rng.choice([0.0, rng.uniform(0.0, 0.2)]),
        kind="differential",
        track=rng.uniform(0.1, 0.3),
        max_wheel_speed=rng.choice([np.inf, rng.uniform(0.2, 0.6)]),
        reverse=bool(rng.random() < 0.8),
    )
    # Starts are 0.5 m apart, so that circles around these boxes are, too.
    footprint = (
        Footprint.circle(rng.uniform(0.2, 0.4)) if rng.random() < 0.7 else Footprint.box(*rng.uniform(0.2, 0.3, 2))
    )
    lidar = LidarConfig(
        scan=ScanConfig(rays=int(rng.integers(200, 700)), range_min=0.05),
        noise=constant_noise(rng.uniform(0.0, 0.01)),
        dropout=rng.uniform(0.0, 0.1),
        rolling=rolling,
        period=rng.uniform(0.08, 0.2),
    )
    return Profile("fuzz", footprint, lidar, drive, 0.1, rng.uniform(0.0, 0.2), odometry=bool(rng.random() < 0.8))


def crash(rng: np.random.Generator) -> str:
    """Drive one team into itself; return the robot and the seed of a run with an overlap."""
    robot = draw_robot(rng)
    seed, robots, hold = int(rng.integers(2**31)), int(rng.integers(2, 8)), rng.uniform(0.1, 1.5)
    scenario = Scenario()
    # A scenario looks its robot up by name; this one has none.
    object.__setattr__(scenario, "_team", Composition.of(robot))
    world = World(sample_starts(robots, 1, seed), robot, seeds=[seed])
    controller = scenario.make_controller(Reckless(seed, hold))
    for _ in range(150):
        world.apply(controller.command(world.observe()), world.control_period)
    return f"an overlap at seed {seed} of {robot}" if world.collided.any() else ""


if __name__ == "__main__":
    given = options(__doc__ or "", tries=10**9, seconds=60)
    sys.exit(campaign("arcs", crash, given.tries, given.seconds, given.seed) > 0)
