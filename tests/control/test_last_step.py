"""A controller that remembers its last step gives what a new one gives, to the bit."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.control import LearnedPolicy, make_controller, shipped_weights
from triform.control.last_step import LastStep
from triform.policy import PackedMaps, PolicyRuntime
from triform.simulation import World, sample_starts, world_seeds
from triform.simulation.shipped import get_profile
from triform.types import Controller, Scan, ScanConfig, View


@pytest.mark.parametrize("name", ["policy", "policy:cnn", "scan-triangulating", "scan-pipeline"])
@pytest.mark.parametrize("profile", ["ideal", "hardware"])
def test_what_is_remembered_changes_nothing(name: str, profile: str) -> None:
    remembering: Controller = make_controller(name)
    sight = 2.0 if name == "policy:cnn" else 3.0
    world = World(sample_starts(4, 2, seed=3), get_profile(profile).seeing(sight), None, world_seeds(4, 3, range(2)))
    for step in range(100):
        view = world.observe()
        command = remembering.command(view)
        if step % 5 == 0:
            np.testing.assert_array_equal(command, make_controller(name).command(view))
        if step == 20:
            world.remove_robot(0, 1)
            command = remembering.command(world.observe())
        if step == 40:
            # The robot in the place of the one that left has had no scan: it sees nobody.
            world.add_robot(0, [0.3, 0.2, 1.0])
            command = remembering.command(world.observe())
        world.apply(command, world.control_period)


class Counting(PolicyRuntime):
    """A policy that notes how many maps it was asked about."""

    asked: int = 0

    def commands(self, packed: PackedMaps):
        self.asked = len(packed.counts)
        return super().commands(packed)


def test_only_robots_that_see_something_new_are_asked_about() -> None:
    runtime = Counting(shipped_weights()["default"])
    policy = LearnedPolicy(runtime)
    view = World(sample_starts(5, 2, seed=1), get_profile("ideal").seeing(3.0), None, [1, 2]).observe()
    first = policy.command(view)
    assert runtime.asked == 10
    ranges = view.scans.ranges.copy()
    ranges[0, 1, 7], ranges[1, 4, 440] = 1.5, np.nan
    policy.command(replace(view, scans=replace(view.scans, ranges=ranges)))
    assert runtime.asked == 2
    # NaN is never what it was, and the other robot sees what it saw first.
    policy.command(replace(view, scans=replace(view.scans, ranges=ranges)))
    assert runtime.asked == 1
    np.testing.assert_array_equal(policy.command(view), first)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(policy)).command(view), first)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_answers_are_those_of_what_is_sensed(seed: int) -> None:
    """Whatever changes, breaks off, comes and goes: an answer that is kept is of the robot's present scan."""
    rng, last, config = np.random.default_rng(seed), LastStep(), ScanConfig(rays=3)
    seen, beside = rng.integers(0, 2, (6, 3)).astype(float), rng.integers(0, 2, (6, 2)).astype(float)
    for _ in range(12):
        rows = rng.random(6) < 0.3
        seen[rows], beside[rng.random(6) < 0.2] = rng.integers(0, 2, (rows.sum(), 3)), rng.integers(0, 2, 2)
        if rng.random() < 0.1:
            config = replace(config, range_max=float(rng.integers(2, 4)))
        active = rng.random(6) < 0.8
        truth = (seen * [1, 2, 4]).sum(1) + (beside * [8, 16]).sum(1) + 32 * config.range_max
        changed, answers = last.compare(Scan(seen[None].copy(), config), beside, active, 1)
        assert not changed[~active].any()
        if rng.random() < 0.2:
            # The controller failed after it wrote a half of its answers.
            answers[changed] = np.nan
            continue
        answers[changed, 0] = truth[changed]
        last.keep()
        np.testing.assert_array_equal(answers[active, 0], truth[active])


def test_another_lidar_is_another_step() -> None:
    last, beside, active = LastStep(), np.zeros((2, 3)), np.ones(2, dtype=bool)
    scans = Scan(np.full((1, 2, 4), 1.0), ScanConfig(rays=4))
    assert last.compare(scans, beside, active, 1)[0].all()
    last.keep()
    assert not last.compare(scans, beside, active, 1)[0].any()
    turned = replace(scans, config=ScanConfig(rays=4, angle_min=0.5))
    assert last.compare(turned, beside, active, 1)[0].all()


def test_views_of_controllers_that_are_copied_share_nothing() -> None:
    policy = make_controller("scan-triangulating")
    view = View(Scan(np.full((1, 1, 450), np.inf), ScanConfig(range_max=3.0)), np.ones((1, 1), dtype=bool), 0.0)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(policy)).command(view), policy.command(view))
