"""The safety filter: half-planes against brute force, SciPy and Shapely, and robots that want to collide."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from shapely import Point, box

from tests.controllers import Given
from triform.control import safety
from triform.control.expert import Expert
from triform.control.safety import SafetyFilter, SafetySettings, reaction_time
from triform.control.safety_kernels import gap_along, nearest_allowed
from triform.control.scan_pipeline import ScanPipeline
from triform.geometry.footprint import ROBOMASTER_EP, Footprint
from triform.simulation.arena import Arena, get_arena
from triform.simulation.kinematics import limit_twists
from triform.simulation.lidar import cast_scans
from triform.simulation.profiles import HARDWARE, IDEAL, Drive, Profile, constant_noise
from triform.simulation.spawning import sample_starts
from triform.simulation.world import World
from triform.threads import limit_threads
from triform.types import ConfigurationError, Controller, FloatArray, PrivilegedView, Scan, ScanConfig, View

CONFIG = ScanConfig()


class Crush:
    """Everybody drives towards the middle of all at full speed."""

    privileged = True

    @property
    def description(self):
        return {"name": "crush"}

    def command(self, view: PrivilegedView) -> FloatArray:
        ahead = view.poses[..., :2].mean(axis=1, keepdims=True) - view.poses[..., :2]
        angle = np.arctan2(ahead[..., 1], ahead[..., 0]) - view.poses[..., 2]
        return np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), np.zeros_like(angle)], axis=-1)


def look(poses, footprint=ROBOMASTER_EP, time=9.0, config=CONFIG) -> PrivilegedView:
    poses = np.asarray(poses, dtype=float)
    active = np.ones(poses.shape[:2], bool)
    return PrivilegedView(Scan(cast_scans(poses, active, footprint, Arena.open(), config), config), active, time, poses)


def view_of(ranges, time=9.0) -> View:
    return View(Scan(np.asarray(ranges, dtype=float)[None, None], CONFIG), np.ones((1, 1), bool), time)


def ray_at(angle: float) -> int:
    return round((angle - CONFIG.angle_min) / CONFIG.angle_increment) % CONFIG.rays


def nearest_by_brute_force(wanted, planes) -> FloatArray:
    """The best of all places where an optimum can be: the wanted one, its foot on every line, and all crossings."""
    normals, bounds = planes[:, :2], planes[:, 2]
    places = [wanted, *(wanted - np.outer(normals @ wanted - bounds, np.ones(2)) * normals)]
    for i in range(len(planes)):
        for j in range(i):
            if abs(np.linalg.det(normals[[i, j]])) > 1e-12:
                places.append(np.linalg.solve(normals[[i, j]], bounds[[i, j]]))
    places = np.array(places)
    allowed = (places @ normals.T <= bounds + 1e-10).all(axis=1)
    return places[allowed][np.argmin(np.linalg.norm(places[allowed] - wanted, axis=1))]


plane = st.tuples(st.integers(0, 23), st.one_of(st.just(0.0), st.floats(0, 0.6))).map(
    lambda p: (np.cos(p[0] * np.pi / 12), np.sin(p[0] * np.pi / 12), p[1])
)
velocity = st.tuples(st.floats(-1, 1), st.floats(-1, 1)).map(np.array)


@settings(max_examples=300, deadline=None)
@given(wanted=velocity, planes=st.lists(plane, min_size=1, max_size=12).map(np.array))
def test_the_nearest_allowed_velocity_is_that_of_brute_force(wanted, planes):
    found = np.array(nearest_allowed(*wanted, planes, len(planes)))
    assert (planes[:, :2] @ found <= planes[:, 2] + 1e-9).all()
    np.testing.assert_allclose(found, nearest_by_brute_force(wanted, planes), atol=1e-8)
    assert np.linalg.norm(found) <= np.linalg.norm(wanted) + 1e-12
    if (planes[:, :2] @ wanted <= planes[:, 2]).all():
        assert tuple(found) == tuple(wanted)


def test_the_nearest_allowed_velocity_is_that_of_scipy():
    rng = np.random.default_rng(1)
    for _ in range(40):
        angles, wanted = rng.uniform(-np.pi, np.pi, 30), rng.uniform(-1, 1, 2)
        planes = np.column_stack([np.cos(angles), np.sin(angles), rng.uniform(0, 0.5, 30)])
        rules = {"type": "ineq", "fun": lambda u, p=planes: p[:, 2] - p[:, :2] @ u}
        best = minimize(
            lambda u, w=wanted: np.sum((u - w) ** 2), np.zeros(2), constraints=rules, options={"ftol": 1e-12}
        )
        np.testing.assert_allclose(nearest_allowed(*wanted, planes, 30), best.x, atol=1e-4)


@settings(max_examples=200, deadline=None)
@given(distance=st.floats(0.21, 3), angle=st.floats(-np.pi, np.pi), round_=st.booleans())
def test_gaps_are_those_of_shapely(distance, angle, round_):
    body = (0.16, 0.16 if round_ else 0.12, round_)
    shape = Point(0, 0).buffer(0.16, quad_segs=2000) if round_ else box(-0.16, -0.12, 0.16, 0.12)
    gap, *normal = gap_along(distance, np.cos(angle), np.sin(angle), body)
    place = distance * np.array([np.cos(angle), np.sin(angle)])
    assert gap == pytest.approx(shape.distance(Point(place)), abs=1e-6)
    assert np.hypot(*normal) == pytest.approx(1)
    # The outline touches the return once it has been moved by the gap.
    assert shape.distance(Point(place - gap * np.array(normal))) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("distance", [0.0, 0.05, 0.11])
def test_within_the_outline_the_ray_is_the_direction(distance):
    gap, *normal = gap_along(distance, np.cos(0.3), np.sin(0.3), (0.16, 0.12, False))
    assert gap < 0
    np.testing.assert_allclose(normal, [np.cos(0.3), np.sin(0.3)])


def test_what_is_far_changes_no_bit():
    view = look(sample_starts(7, 20, seed=1))
    controller = Expert(max_speed=0.01)
    wanted = controller.command(view)
    np.testing.assert_array_equal(SafetyFilter(controller).command(view), wanted)
    assert wanted.any()


def test_the_given_commands_are_not_written_to():
    given_commands = Given([[(0.5, 0, 0), (0.5, 0, 0)]])
    limited = SafetyFilter(given_commands).command(look([[(0, 0, 0), (0.4, 0, 0)]]))
    np.testing.assert_array_equal(given_commands.commands[0, :, 0], 0.5)
    assert limited[0, 0, 0] < 0.1
    assert limited[0, 1, 0] == 0.5


def test_the_speed_ahead_is_the_rate_times_what_is_left():
    guard = SafetySettings(reaction=0.25, min_gap=0.06)
    assert guard.rate == pytest.approx(1 / (2 * np.e * 0.25))
    commands = SafetyFilter(Given([[(0.5, 0.1, 0), (-0.5, 0, 0)]]), guard).command(look([[(0, 0, 0), (0.52, 0, 0)]]))
    np.testing.assert_allclose(commands[0, 0, :2], [guard.rate * 0.14, 0.1], atol=1e-6)
    np.testing.assert_allclose(commands[0, 1, :2], [-guard.rate * 0.14, 0], atol=1e-6)


def test_nearer_than_the_gap_to_keep_only_the_approach_is_forbidden():
    view = look([[(0, 0, 0), (0.35, 0, 0)]])
    for wanted, allowed in (((0.5, 0.2), (0, 0.2)), ((-0.5, 0.2), (-0.5, 0.2)), ((0, 0), (0, 0))):
        commands = SafetyFilter(Given([[(*wanted, 0), (0, 0, 0)]])).command(view)
        np.testing.assert_allclose(commands[0, 0, :2], allowed, atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(turn=st.integers(0, 449), seed=st.integers(0, 1000))
def test_circles_have_no_front(turn, seed):
    rng = np.random.default_rng(seed)
    ranges = look([[(0, 0, 0), (0.4, 0.1, 0), (-0.1, 0.5, 0)]], Footprint.circle(0.3)).scans.ranges[0, 0]
    wanted = rng.uniform(-0.5, 0.5, 2)
    angle = turn * CONFIG.angle_increment
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    guard = SafetySettings(footprint=0.3)
    before = SafetyFilter(Given([[(*wanted, 0)]]), guard).command(view_of(ranges))[0, 0, :2]
    turned = SafetyFilter(Given([[(*(rotation @ wanted), 0)]]), guard).command(view_of(np.roll(ranges, turn)))
    np.testing.assert_allclose(turned[0, 0, :2], rotation @ before, atol=1e-9)


def test_no_robot_becomes_faster():
    view = look(sample_starts(13, 30, seed=4, side=3.2))
    wanted = Crush().command(view)
    limited = SafetyFilter(Crush()).command(view)
    assert (np.linalg.norm(limited, axis=-1) <= np.linalg.norm(wanted, axis=-1) + 1e-12).all()
    assert np.mean(np.any(limited != wanted, axis=-1)) > 0.2


@pytest.mark.parametrize("value", [0.15, -np.inf])
def test_one_ray_alone_is_not_believed(value):
    ranges, k = np.full(CONFIG.rays, np.inf), ray_at(0.0)
    guarded = SafetyFilter(Given([[(0.5, 0, 0)]]))
    ranges[k] = value
    assert guarded.command(view_of(ranges))[0, 0, 0] == 0.5
    ranges[k + 1] = value
    assert guarded.command(view_of(ranges))[0, 0, 0] < 0.01


def test_dropped_rays_and_ranges_that_are_none_open_no_way():
    ranges = look([[(0, 0, 0), (0.4, 0, 0)]]).scans.ranges[0, 0].astype(float)
    whole = SafetyFilter(Given([[(0.5, 0, 0)]])).command(view_of(ranges))
    ranges[::3] = np.resize([np.nan, 0.0, -1.0, 9.0], len(ranges[::3]))
    # Two of three rays are left: the median is the farther of them.
    np.testing.assert_allclose(SafetyFilter(Given([[(0.5, 0, 0)]])).command(view_of(ranges)), whole, atol=1e-3)


def test_a_robot_without_measurements_stands_still():
    guarded = SafetyFilter(Given([[(0.5, 0.1, 0.2)]]))
    free, early = np.full(CONFIG.rays, np.inf), 0.1
    assert not guarded.command(view_of(np.full(CONFIG.rays, np.nan))).any()
    assert not guarded.command(view_of(free, early)).any()
    np.testing.assert_array_equal(guarded.command(view_of(free)), [[[0.5, 0.1, 0.2]]])
    ranges = free.copy()
    ranges[:5] = 1.5
    np.testing.assert_array_equal(guarded.command(view_of(ranges, early)), [[[0.5, 0.1, 0.2]]])


def test_a_robot_within_another_does_not_move():
    assert not SafetyFilter(Given([[(0.5, 0.1, 0)]])).command(view_of(np.full(CONFIG.rays, -np.inf))).any()


def test_robots_that_do_not_exist_are_left_alone():
    view = look([[(0, 0, 0), (0.4, 0, 0)]])
    view = replace(view, active=np.array([[True, False]]))
    commands = SafetyFilter(Given([[(0.5, 0, 0), (0, 0, 0)]])).command(view)
    assert (commands[0, 1] == 0).all()


def test_half_planes_hold_for_what_the_drive_makes_of_a_command():
    drive = Drive(max_speed=0.5, max_axis_speed=0.1)
    view = look(sample_starts(13, 30, seed=5, side=3.2))
    wanted = Given(np.random.default_rng(2).uniform(-1, 1, (30, 13, 3)) * [1, 1, 0])
    guard = SafetySettings(max_speed=0.5, max_axis_speed=0.1)
    driven = limit_twists(SafetyFilter(wanted, guard).command(view), drive)
    # What is driven passes a second time: it was allowed.
    np.testing.assert_allclose(SafetyFilter(Given(driven)).command(view), driven, atol=1e-12)
    assert (driven != limit_twists(wanted.commands, drive)).any()


def test_a_robot_turns_only_while_its_circle_is_free():
    beside = look([[(0, 0, 0), (0, 0.3, 0)]])
    commands = SafetyFilter(Given([[(0.1, 0.1, 1.0), (0, 0, 0)]])).command(beside)
    assert commands[0, 0, 2] == 0
    assert commands[0, 0, 1] < 0.1
    free = look([[(0, 0, 0), (0, 0.9, 0)]])
    np.testing.assert_array_equal(
        SafetyFilter(Given([[(0.1, 0.1, 1.0), (0, 0, 0)]])).command(free)[0, 0], [0.1, 0.1, 1.0]
    )


def drive_for(world: World, controller, seconds: float) -> None:
    for _ in range(round(seconds / world.control_period)):
        world.apply(controller.command(world.observe()), world.control_period)


def tried(sigma: float, latency: float, dropout: float = 0.0) -> Profile:
    noise = constant_noise(sigma) if sigma else ()
    return replace(IDEAL, latency=latency, lidar=replace(IDEAL.lidar, noise=noise, dropout=dropout))


WORST = tried(0.02, 0.2, 0.3)


@pytest.mark.parametrize("profile", [IDEAL, tried(0.02, 0.0), tried(0.0, 0.2), WORST])
def test_robots_head_on_never_overlap(profile):
    rng = np.random.default_rng(3)
    poses = np.zeros((40, 2, 3))
    poses[..., 2] = rng.uniform(-np.pi, np.pi, (40, 2))
    poses[:, 1, 0] = rng.uniform(0.5, 2.0, 40)
    plain, guarded = (World(poses, profile, seeds=range(40)) for _ in range(2))
    drive_for(plain, Crush(), 5)
    drive_for(guarded, SafetyFilter(Crush()), 15)
    assert plain.collided.all()
    assert not guarded.collided.any()
    # They do come near: the layer is no wall.
    assert np.median(guarded.min_distance) < 0.45


@pytest.mark.parametrize("profile", [IDEAL, WORST])
def test_a_crowd_never_overlaps(profile):
    world = World(sample_starts(9, 12, seed=6), profile, seeds=range(12))
    drive_for(world, SafetyFilter(Crush()), 15)
    assert not world.collided.any()
    assert world.min_distance.max() < 0.45


@pytest.mark.parametrize("arena", ["room-6", "pillars", "living-room"])
def test_walls_and_pillars_are_not_hit(arena):
    class Flee(Crush):
        def command(self, view: PrivilegedView) -> FloatArray:
            return -super().command(view)

    plain, guarded = (World(sample_starts(7, 10, seed=6), WORST, get_arena(arena), range(10)) for _ in range(2))
    drive_for(plain, Flee(), 15)
    drive_for(guarded, SafetyFilter(Flee()), 15)
    assert plain.hit_arena.all()
    assert not guarded.hit_arena.any()
    assert not guarded.collided.any()


def test_the_hardware_keeps_apart_too():
    drive, lidar = HARDWARE.drive, HARDWARE.lidar
    reaction = reaction_time(HARDWARE.control_period, lidar.period, HARDWARE.latency, lidar.rolling, drive.lag)
    guard = SafetySettings(reaction=reaction, max_speed=drive.max_speed, max_axis_speed=drive.max_axis_speed)
    world = World(sample_starts(7, 6, seed=6, side=2.5), HARDWARE, seeds=range(6))
    drive_for(world, SafetyFilter(Crush(), guard), 20)
    assert not world.collided.any()


def test_a_lagging_drive_with_the_reaction_time_does_not_overshoot():
    # One gap X, two robots that each approach at the allowed rate: X' = -v, lag v' = 2 rate X(t - delay) - v.
    step = 1e-3
    for lag, delay in ((0.0, 0.3), (0.1, 0.3), (0.3, 0.3), (0.3, 0.001)):
        rate = SafetySettings(reaction=reaction_time(delay, 0.0, lag=lag)).rate
        old, speed = [1.0] * (round(delay / step) + 1), 0.0
        for _ in range(5000):
            wanted = 2 * rate * old[-1 - round(delay / step)]
            speed = wanted if lag == 0 else speed + (wanted - speed) * step / lag
            old.append(old[-1] - speed * step)
        assert min(old) > 0


def test_reaction_is_the_age_of_the_oldest_measurement_in_use():
    assert SafetySettings().reaction == pytest.approx(reaction_time(0.1, 0.1, latency=0.2))
    assert reaction_time(0.125, 0.25, rolling=True, lag=0.2) == pytest.approx(0.125 + 0.5 + 0.3)


def test_it_describes_itself_and_what_it_guards():
    guarded: Controller[View] = SafetyFilter(ScanPipeline(), SafetySettings(footprint=0.3, max_axis_speed=0.1))
    assert not guarded.privileged
    described = json.loads(json.dumps(guarded.description, allow_nan=False))
    assert described["name"] == "scan-pipeline"
    assert described["guard"] == {
        "footprint": {"shape": "circle", "length": 0.3, "width": 0.3},
        "min_gap": 0.05, "reaction": 0.4, "max_speed": None, "max_axis_speed": 0.1, "pace": 1.0,
    }  # fmt: skip
    assert SafetyFilter(Expert()).privileged


def test_the_number_of_threads_does_not_matter(monkeypatch):
    monkeypatch.setattr(safety, "ROBOTS_PER_THREAD", 1)
    view = look(sample_starts(9, 8, seed=4, side=2.5))
    parallel = SafetyFilter(Crush()).command(view)
    with limit_threads(1):
        np.testing.assert_array_equal(SafetyFilter(Crush()).command(view), parallel)


@pytest.mark.parametrize(
    "bad",
    [
        {"min_gap": -0.1},
        {"reaction": 0},
        {"max_speed": np.nan},
        {"max_axis_speed": 0},
        {"pace": 0},
        {"pace": 1.1},
        {"footprint": (0.3, -1)},
    ],
)
def test_impossible_guards_are_refused(bad):
    with pytest.raises(ConfigurationError, match=next(iter(bad))):
        SafetySettings(**bad)
