"""The model-based controllers from one scan, against those that see true poses, and in closed loop."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from triform.control import scan_pipeline
from triform.control.detection import detect_robots
from triform.control.expert import Expert
from triform.control.scan_pipeline import ScanPipeline
from triform.control.triangulating import Triangulating, TriangulatingLaw
from triform.evaluation.rollout import rollout
from triform.geometry import assess, edge_error
from triform.geometry.footprint import ROBOMASTER_EP, Footprint
from triform.simulation.arena import Arena
from triform.simulation.lidar import cast_scans
from triform.simulation.shipped import get_profile
from triform.simulation.spawning import sample_starts
from triform.simulation.world import World
from triform.threads import limit_threads
from triform.types import ConfigurationError, Controller, PrivilegedView, Scan, ScanConfig, View

CONFIG = ScanConfig()
#: Of robots whose LiDAR reaches 2 d*.
LAW = TriangulatingLaw(sight=2.1)


def look(poses, footprint=ROBOMASTER_EP, active=None, config=CONFIG) -> PrivilegedView:
    poses = np.asarray(poses, dtype=float)
    active = np.ones(poses.shape[:2], bool) if active is None else active
    ranges = cast_scans(poses, active, footprint, Arena.open(), config)
    return PrivilegedView(Scan(ranges, config), active, 0.0, np.where(active[..., None], poses, np.nan))


def pushed(view, seed=0) -> PrivilegedView:
    return replace(view, noise=np.random.default_rng(seed).standard_normal((*view.active.shape, 2)))


def test_it_is_a_controller_for_any_view_and_describes_itself():
    controller: Controller[View] = ScanPipeline(distance=0.8, footprint=0.3)
    assert not controller.privileged
    described = json.loads(json.dumps(controller.description))
    assert described["name"] == "scan-pipeline"
    assert described["distance"] == 0.8
    assert described["footprint"] == {"shape": "circle", "length": 0.3, "width": 0.3}


def test_commands_agree_with_the_expert_that_sees_as_far():
    # Within 2 m of sight the true neighbours are those of the expert, if nobody stands at the very limit.
    view = look(sample_starts(7, 60, seed=2))
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
    view = look(sample_starts(7, 10, seed=1))
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
    ranges = look(sample_starts(5, 20, seed=4)).scans.ranges
    broken = rng.random(ranges.shape)
    ranges[broken < 0.3] = np.nan
    ranges[broken < 0.2] = -np.inf
    ranges[broken < 0.1] = np.inf
    command = ScanPipeline().command(View(Scan(ranges, CONFIG), np.ones(ranges.shape[:2], bool), 0.0))
    assert np.isfinite(command).all()
    assert np.linalg.norm(command, axis=-1).max() <= 1 + 1e-12


def test_the_number_of_threads_changes_nothing(monkeypatch):
    monkeypatch.setattr(scan_pipeline, "SCANS_PER_THREAD", 1)
    view = look(sample_starts(5, 8, seed=4))
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
    world = World(sample_starts(robots, 8, seed=7), profile)
    controller = ScanPipeline()
    for _ in range(round(30 / profile.control_period)):
        world.apply(controller.command(world.observe()), profile.control_period)
    error = edge_error(world.poses[..., :2])
    assert np.median(error) < limit
    assert not world.collided.any()


def triangle(distance=1.0, bent=0.05):
    """Three robots and a fourth beyond an edge, none in front of another, nearly at rest [m, m, rad]."""
    high = np.sqrt(3) / 2
    places = np.array([(0, 0), (1 + bent, 0), (0.5, high), (1.5, high - bent)])
    headings = np.array([0.3, -1.0, 2.0, 0.7])
    return np.column_stack([distance * places, headings])[None]


@pytest.mark.parametrize("distance", [0.7, 1.0, 1.5])
@pytest.mark.parametrize("bent", [0.02, 0.3])
def test_the_triangulating_law_is_applied_to_what_is_detected(distance, bent):
    view = pushed(look(triangle(distance, bent), config=ScanConfig(range_max=2 * distance)))
    scanned = ScanPipeline(distance, max_speed=9, law=LAW).command(view)
    # Detection is good to a millimetre, and the law's steepest term turns that into some 25 mm/s.
    np.testing.assert_allclose(scanned, Triangulating(distance, max_speed=9, law=LAW).command(view), atol=0.03)
    assert np.abs(scanned).max() > 0.05


def test_random_teams_get_the_triangulating_law_of_those_in_sight():
    view = pushed(look(sample_starts(5, 80, seed=2)))
    gap = np.linalg.norm(
        ScanPipeline(law=LAW).command(view)[..., :2] - Triangulating(max_speed=1, law=LAW).command(view)[..., :2],
        axis=-1,
    )
    assert np.median(gap) < 0.001
    assert np.mean(gap < 0.02) > 0.85


def test_the_push_is_as_large_as_the_law_says():
    # No edge of a bent row of three robots that see each other has a triangle.
    view = look([[(0, 0, 0), (1, 0, 0), (1.3, 1.1, 0)]])
    controller = ScanPipeline(law=LAW, max_speed=99)
    noise = np.array([[(0.3, -0.2), (1.0, 2.0), (-0.4, 0.1)]])
    difference = controller.command(replace(view, noise=noise)) - controller.command(view)
    np.testing.assert_allclose(difference[..., :2], LAW.bridge_push * noise, atol=1e-12)


def test_everything_scaled_gives_scaled_commands():
    law = {"law": LAW, "max_speed": 99}
    small = pushed(look(triangle(), Footprint.circle(0.3)))
    large = pushed(look(triangle(1.6), Footprint.circle(0.48), config=ScanConfig(range_max=3.2)))
    np.testing.assert_allclose(
        ScanPipeline(1.6, footprint=0.48, **law).command(large),
        1.6 * ScanPipeline(1.0, footprint=0.3, **law).command(small),
        atol=0.02,
    )


def test_the_triangulating_law_uses_no_more_of_the_lidar_than_its_sight():
    controller = ScanPipeline(law=LAW)
    poses, law = [[(0, 0, 0), (1.1, 0, 0.4), (0.5, 0.9, 0), (-1.9, 0.3, 1), (0.2, -3, 0)]], LAW
    far, near = (controller.command(look(poses, config=ScanConfig(range_max=limit))) for limit in (8.0, 2.1))
    np.testing.assert_array_equal(far, near)
    # The near side of a robot beyond the law's sight shows, but the robot does not count.
    for away, counts in ((law.sight - 0.02, True), (law.sight + 0.02, False)):
        view = look([[(0, 0, 0), (away, 0, 0)]], Footprint.circle(0.6), config=ScanConfig(range_max=2.1))
        assert detect_robots(view.scans, 0.6)[1].tolist() == [[1, 1]]
        assert ScanPipeline(law=LAW, footprint=0.6).command(view).any() == counts


def test_it_describes_the_triangulating_law():
    described = json.loads(json.dumps(ScanPipeline(law=LAW).description))
    assert described["name"] == "scan-triangulating"
    assert described["law"] == asdict(LAW)
    assert "gain" not in described


def test_the_triangulating_law_has_room_for_many_robots():
    spacing = np.linspace(-1.8, 1.8, 10)
    poses = np.array([(x, y, 0) for x in spacing for y in spacing])[None]
    command = ScanPipeline(law=LAW, footprint=(0.05, 0.04)).command(look(poses, Footprint.box(0.05, 0.04)))
    assert np.isfinite(command).all()
    assert np.linalg.norm(command, axis=-1).max() <= 1 + 1e-12


def test_five_robots_triangulate_from_scans_alone():
    world = World(sample_starts(5, 6, seed=7), get_profile("ideal"))
    trajectory = rollout(world, ScanPipeline(law=LAW), 40)
    assert assess(trajectory.positions[:, -1]).strict.all()
    assert not world.collided.any()
