"""The safety filter on arcs: its bound restated in plain geometry, and rolling robots that want to collide."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Point

from tests.controllers import Given
from tests.fuzz.arcs import Reckless
from triform.control import SafetyFilter, SafetySettings, make_controller, rolling_arcs
from triform.evaluation.scenario import Scenario
from triform.simulation import (
    Arena,
    Composition,
    Drive,
    Footprint,
    LidarConfig,
    Profile,
    World,
    constant_noise,
    get_arena,
    limit_twists,
    sample_starts,
)
from triform.simulation.lidar import cast_scans
from triform.types import FloatArray, PrivilegedView, Scan, ScanConfig, View

DRIVE = Drive(
    max_speed=0.3, max_turn_rate=1.9, max_acceleration=0.9, max_turn_acceleration=7.7, lag=0.1,
    kind="differential", track=0.233,
)  # fmt: skip
ROLLING = LidarConfig(scan=ScanConfig(rays=360), rolling=True, period=0.13, noise=constant_noise(0.01), dropout=0.05)
ROBOT = Profile("rolling", Footprint.circle(0.342), ROLLING, DRIVE, control_period=0.1, latency=0.1)
QUICK = replace(ROBOT, drive=replace(DRIVE, max_turn_rate=4.0, max_turn_acceleration=30.0, lag=0.02), latency=0.0)
BOX = replace(ROBOT, footprint=Footprint.box(0.28, 0.30))
FORWARD = replace(ROBOT, drive=replace(DRIVE, reverse=False))
BLIND = replace(ROBOT, odometry=False)


class Crush:
    """Everybody drives towards the middle of all at full speed."""

    privileged = True

    @property
    def description(self):
        return {"name": "crush"}

    def command(self, view: PrivilegedView) -> FloatArray:
        ahead = view.poses[..., :2].mean(axis=1, keepdims=True) - view.poses[..., :2]
        angle = np.arctan2(ahead[..., 1], ahead[..., 0]) - view.poses[..., 2]
        return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)


def guarded(controller, profile: Profile) -> SafetyFilter:
    """The filter that a scenario of these robots has."""
    scenario = Scenario()
    object.__setattr__(scenario, "_team", Composition.of(profile))
    filtered = scenario.make_controller(controller)
    assert isinstance(filtered, SafetyFilter)
    return filtered


def drive_for(world: World, controller, seconds: float) -> None:
    for _ in range(round(seconds / world.control_period)):
        world.apply(controller.command(world.observe()), world.control_period)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-2, 2)), st.booleans())
def test_the_speed_is_what_every_return_allows(seed: int, twist: tuple[float, float, float], moved: bool) -> None:
    """The bound of the text, restated: gaps by Shapely, from where the robot rests, and the straightest approach."""
    rng = np.random.default_rng(seed)
    config = ScanConfig(rays=90)
    poses = np.zeros((1, 4, 3))
    angles = rng.uniform(-np.pi, np.pi, 3)
    poses[0, 1:, :2] = (rng.uniform(0.4, 1.0, 3) * [np.cos(angles), np.sin(angles)]).T
    active = np.ones((1, 4), bool)
    ranges = cast_scans(poses, active, Footprint.circle(0.3), Arena.open(), config)[:, :1]
    resting = rng.uniform(-1, 1, 3) * [0.05, 0.05, 0.6] if moved else np.zeros(3)
    view = View(Scan(ranges, config), np.ones((1, 1), bool), 9.0, odometry=resting[None, None])
    arcs = rolling_arcs(DRIVE.wheels, 0.1, 0.2)
    law = SafetySettings(0.3, reaction=0.6, arcs=arcs)
    along, side, turn = SafetyFilter(Given([[twist]]), law).command(view)[0, 0]
    wanted = limit_twists(np.array(twist), DRIVE)
    assert side == 0.0
    assert turn == wanted[2]
    limit, outline = abs(wanted[0]), Point(*resting[:2]).buffer(0.15, quad_segs=500)
    measured = np.where(np.isfinite(ranges[0, 0]), ranges[0, 0], np.inf)
    sure = np.median([np.roll(measured, 1), measured, np.roll(measured, -1)], axis=0)
    swept = arcs.slack + abs(turn) * arcs.hold
    for distance, angle in zip(sure, config.angles, strict=True):
        if np.isfinite(distance):
            place = distance * np.array([np.cos(angle), np.sin(angle)])
            away = (place - resting[:2]) @ [[1, 1j], [1j, -1]] @ [1, 0]
            bearing = abs(np.angle(away * np.exp(-1j * (resting[2] + (np.pi if wanted[0] < 0 else 0.0)))))
            closing = np.cos(max(bearing - swept, 0.0))
            if closing > 1e-9:
                limit = min(limit, law.rate * max(outline.distance(Point(place)) - law.min_gap, 0.0) / closing)
    assert abs(along) == pytest.approx(limit, abs=1e-5)
    assert along * wanted[0] >= 0


def test_what_is_free_is_driven_to_the_bit() -> None:
    view = World(
        sample_starts(5, 4, seed=1) * [3, 3, 1], replace(ROBOT, lidar=replace(ROLLING, rolling=False)), seeds=range(4)
    ).observe()
    wanted = np.random.default_rng(0).uniform(-1, 1, (4, 5, 3)) * [0.02, 0.02, 2.0]
    view = replace(view, time=9.0, scans=Scan(np.full_like(view.scans.ranges, np.inf), view.scans.config))
    np.testing.assert_array_equal(guarded(Given(wanted), ROBOT).command(view), limit_twists(wanted, DRIVE))


def test_a_robot_without_measurements_stands_still() -> None:
    view = View(Scan(np.full((1, 1, 360), np.nan), ScanConfig(rays=360)), np.ones((1, 1), bool), 9.0)
    assert not guarded(Given([[(0.3, 0.1, 1.0)]]), ROBOT).command(view).any()


@pytest.mark.parametrize("profile", [ROBOT, QUICK, FORWARD, BOX, BLIND])
def test_robots_head_on_never_overlap(profile: Profile) -> None:
    rng = np.random.default_rng(3)
    poses = np.zeros((30, 2, 3))
    poses[..., 2] = rng.uniform(-np.pi, np.pi, (30, 2))
    poses[:, 1, 0] = rng.uniform(0.55, 1.5, 30)
    plain, safe = (World(poses, profile, seeds=range(30)) for _ in range(2))
    drive_for(plain, Crush(), 8)
    drive_for(safe, guarded(Crush(), profile), 20)
    assert plain.collided.all()
    assert not safe.collided.any()
    # They do come near: the filter is no wall.
    assert np.median(safe.min_distance) < 0.6


@pytest.mark.parametrize("profile", [ROBOT, QUICK, BOX])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_rolling_crowd_never_overlaps(profile: Profile, seed: int) -> None:
    world = World(sample_starts(7, 8, seed), profile, seeds=range(8))
    drive_for(world, guarded(Reckless(seed, 0.8), profile), 20)
    assert not world.collided.any()
    assert np.median(world.min_distance) < 0.65


def test_walls_and_pillars_are_not_hit() -> None:
    class Flee(Crush):
        def command(self, view: PrivilegedView) -> FloatArray:
            return -super().command(view)

    for arena in ("room-6", "pillars"):
        world = World(sample_starts(5, 6, seed=6), ROBOT, get_arena(arena), range(6))
        drive_for(world, guarded(Flee(), ROBOT), 20)
        assert not world.hit_arena.any()
        assert not world.collided.any()


def test_it_describes_itself_in_plain_json() -> None:
    described = guarded(make_controller("scan-pipeline"), ROBOT).description
    guard = json.loads(json.dumps(described, allow_nan=False))["guard"]
    assert guard["wheels"]["max_turn_rate"] == 1.9
    assert guard["wheels"]["max_wheel_speed"] is None
