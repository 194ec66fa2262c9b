"""Teams of five whose LiDARs see an arm of their own robot, or hang upside down, with and without being told.

python -m tests.fuzz.mountings --runs 40 --profile ideal
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from triform.evaluation import Scenario, rollout, summarise
from triform.simulation import Mounting, Placement, World, sample_starts, world_seeds
from triform.types import Controller, FloatArray, RangeArray, Scan, View

#: The arm, in front: ten degrees of returns at 0.12 m, within the robot's outline.
ARM_WIDTH, ARM_RANGE = 10.0, 0.12


class Altered:
    """A controller whose scans are altered."""

    privileged = False

    def __init__(self, controller: Controller[Any], alter: Callable[[RangeArray], RangeArray]) -> None:
        """Alter scans before a controller sees them."""
        self._controller, self._alter = controller, alter
        self.description = controller.description

    def command(self, view: View) -> FloatArray:
        """Body twists by what is left of the scans."""
        scans = Scan(np.ascontiguousarray(self._alter(view.scans.ranges)), view.scans.config)
        return self._controller.command(View(scans, view.active, view.time, noise=view.noise, odometry=view.odometry))


def run(runs: int, profile: str) -> int:
    """Run the teams of every condition and print how they end; returns the conditions that end otherwise than stated.

    Args:
        runs: Teams of each condition.
        profile: Robot profile.
    """
    scenario = Scenario(profile=profile)
    robot = scenario.robot
    angles = robot.lidar.scan.angles
    ahead = np.abs(np.degrees(angles)) <= ARM_WIDTH / 2
    own = Placement(robot.lidar.scan, body=robot.footprint.body)
    blind = replace(robot, mounting=Mounting(blind_sectors=((354.0, 6.0),)))
    # Hanging, ray k shows what is at the opposite angle.
    mirrored = np.argmin(np.abs(np.remainder(angles[:, None] + angles + np.pi, 2 * np.pi) - np.pi), axis=1)

    def arm(ranges: RangeArray) -> RangeArray:
        return np.where(ahead, ranges.dtype.type(ARM_RANGE), ranges)

    conditions: dict[str, tuple[Any, Callable[[RangeArray], RangeArray], bool]] = {
        "no arm": (robot, lambda ranges: ranges, True),
        "an arm that is not known": (robot, arm, False),
        "an arm within the known outline": (robot, lambda ranges: own.masked(arm(ranges)), True),
        "an arm in a blind sector": (blind, lambda ranges: np.where(np.isnan(ranges), ranges, arm(ranges)), True),
        "upside down, not known": (robot, lambda ranges: ranges[..., mirrored], False),
    }
    failed = 0
    for label, (kind, alter, forms) in conditions.items():
        world = World(sample_starts(5, runs, 7), kind, seeds=world_seeds(5, 7, range(runs)))
        controller = Altered(scenario.make_controller("policy"), alter)
        found = summarise(scenario.measure(rollout(world, controller, scenario.duration), world))
        success, error = found["success"], found["formation_error_median"]
        failed += (success >= 0.95) != forms
        print(f"{label:35} success {100 * success:5.1f} %   median formation error {100 * error:7.1f} %", flush=True)
    print(f"mountings: {len(conditions)} conditions of {runs} teams tried, {failed} failed")
    return failed


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--profile", default="ideal")
    given = parser.parse_args()
    sys.exit(run(given.runs, given.profile) > 0)
