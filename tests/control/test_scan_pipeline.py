"""The model-based controller from one scan, against the expert and in closed loop."""

from __future__ import annotations

import json

import numpy as np
import pytest

from triform.control import scan_pipeline
from triform.control.expert import Expert
from triform.control.scan_pipeline import ScanPipeline
from triform.geometry import edge_error
from triform.simulation.arena import Arena
from triform.simulation.lidar import cast_scans
from triform.simulation.profiles import ROBOMASTER_EP, Footprint, get_profile
from triform.simulation.spawning import starts
from triform.simulation.world import World
from triform.threads import limit_threads
from triform.types import ConfigurationError, Controller, PrivilegedView, Scan, ScanConfig, View

CONFIG = ScanConfig()


def look(poses, footprint=ROBOMASTER_EP, active=None) -> PrivilegedView:
    poses = np.asarray(poses, dtype=float)
    active = np.ones(poses.shape[:2], bool) if active is None else active
    ranges = cast_scans(poses, active, footprint, Arena.open(), CONFIG)
    return PrivilegedView(Scan(ranges, CONFIG), active, 0.0, np.where(active[..., None], poses, np.nan))


def test_it_is_a_controller_for_any_view_and_describes_itself():
    controller: Controller[View] = ScanPipeline(distance=0.8, footprint=0.3)
    assert not controller.privileged
    described = json.loads(json.dumps(controller.description))
    assert described["name"] == "scan-pipeline"
    assert described["distance"] == 0.8
    assert described["footprint"] == {"shape": "circle", "length": 0.3, "width": 0.3}


def test_commands_agree_with_the_expert_that_sees_as_far():
    # Within 2 m of sight the true neighbours are those of the expert, if nobody stands at the very limit.
    view = look(starts(7, 60, seed=2))
    gap = np.linalg.norm(
        ScanPipeline(max_speed=9).command(view) - Expert(max_speed=9, sensing_range=2).command(view), axis=-1
    )
    assert np.median(gap) < 0.001
    assert np.mean(gap < 0.02) > 0.85


def test_far_neighbours_attract_and_near_ones_repel():
    for gap, sign in ((1.5, 1), (0.6, -1)):
        command = ScanPipeline().command(look([[(0, 0, 0), (gap, 0, 0.4)]]))
        assert np.sign(command[0, 0, 0]) == sign
        np.testing.assert_allclose(command[0, 0], [gap - 1, 0, 0], atol=0.01)
    np.testing.assert_allclose(ScanPipeline().command(look([[(0, 0, 0), (1, 0, 0.4)]])), 0, atol=0.01)


def test_gain_and_distance_scale_the_command():
    view = look([[(0, 0, 0), (1.5, 0, 0.4)]])
    command = ScanPipeline(distance=1.3, gain=2.0).command(view)
    np.testing.assert_allclose(command[0, 0], [0.4, 0, 0], atol=0.02)


def test_long_commands_are_shortened_and_keep_their_direction():
    view = look(starts(7, 10, seed=1))
    full = ScanPipeline(max_speed=100).command(view)
    short = ScanPipeline(max_speed=0.1).command(view)
    speed = np.linalg.norm(full, axis=-1, keepdims=True)
    np.testing.assert_allclose(short, full * np.minimum(1, 0.1 / np.maximum(speed, 1e-12)), atol=1e-12)
    assert (full[..., 2] == 0).all()


def test_a_robot_that_is_told_the_circle_sees_circles():
    view = look([[(0, 0, 0), (1.4, 0, 0), (0, -0.7, 0)]], Footprint.circle(0.26))
    command = ScanPipeline(footprint=0.26).command(view)
    np.testing.assert_allclose(command[0, 0], [0.4, 0.3, 0], atol=1e-3)


def test_inactive_robots_stand_still_and_are_not_seen():
    view = look([[(0, 0, 0), (0.6, 0, 0), (0, 1.5, 0)]], active=np.array([[True, False, True]]))
    command = ScanPipeline().command(view)
    assert (command[0, 1] == 0).all()
    np.testing.assert_allclose(command[0, 0], [0, 0.5, 0], atol=0.01)


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("robots", [1, 2])
def test_a_robot_that_sees_nothing_stands_still(value, robots):
    view = View(Scan(np.full((3, robots, 450), value), CONFIG), np.ones((3, robots), bool), 0.0)
    command = ScanPipeline().command(view)
    assert command.shape == (3, robots, 3)
    assert (command == 0).all()


def test_broken_rays_give_finite_commands():
    rng = np.random.default_rng(0)
    ranges = look(starts(5, 20, seed=4)).scans.ranges
    broken = rng.random(ranges.shape)
    ranges[broken < 0.3] = np.nan
    ranges[broken < 0.2] = -np.inf
    ranges[broken < 0.1] = np.inf
    command = ScanPipeline().command(View(Scan(ranges, CONFIG), np.ones(ranges.shape[:2], bool), 0.0))
    assert np.isfinite(command).all()
    assert np.linalg.norm(command, axis=-1).max() <= 1 + 1e-12


def test_the_number_of_threads_changes_nothing(monkeypatch):
    monkeypatch.setattr(scan_pipeline, "SCANS_PER_THREAD", 1)
    view = look(starts(5, 8, seed=4))
    parallel = ScanPipeline().command(view)
    with limit_threads(1):
        np.testing.assert_array_equal(ScanPipeline().command(view), parallel)


@pytest.mark.parametrize("bad", [{"distance": 0}, {"gain": np.inf}, {"max_speed": np.nan}, {"footprint": (0.3, -1)}])
def test_impossible_settings_are_refused(bad):
    with pytest.raises(ConfigurationError, match=next(iter(bad))):
        ScanPipeline(**bad)


@pytest.mark.parametrize(("robots", "limit"), [(5, 0.002), (9, 0.01)])
def test_formations_close_in_from_scans_alone(robots, limit):
    profile = get_profile("ideal")
    world = World(starts(robots, 8, seed=7), profile)
    controller = ScanPipeline()
    for _ in range(round(30 / profile.control_period)):
        world.apply(controller.command(world.observe()), profile.control_period)
    error = edge_error(world.poses[..., :2])
    assert np.median(error) < limit
    assert not world.collided.any()
