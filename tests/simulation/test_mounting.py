"""A LiDAR mounted anywhere on its base: what is the robot itself, and scans as seen from the base's centre."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from triform.simulation import (
    HARDWARE,
    IDEAL,
    ROBOMASTER_EP,
    Arena,
    Footprint,
    Mounting,
    Placement,
    World,
    cast_scans,
    get_profile,
)
from triform.simulation.mounting import OUTLINE_MARGIN, read_sectors
from triform.types import ConfigurationError, ScanConfig

SCAN = ScanConfig(rays=450, range_min=0.02, range_max=2.0)
footprints = st.sampled_from([ROBOMASTER_EP, Footprint.circle(0.3), Footprint.box(0.3, 0.5)])
places = st.floats(-0.2, 0.2)


@settings(deadline=None, max_examples=60)
@given(footprints, places, places, st.integers(0, 2**32 - 1))
def test_what_ends_within_the_outline_and_nothing_else_is_unknown(
    footprint: Footprint, x: float, y: float, seed: int
) -> None:
    """Shapely's polygon of the outline, grown by the margin, decides."""
    ranges = np.random.default_rng(seed).uniform(0.02, 0.6, SCAN.rays)
    masked = Placement(SCAN, Mounting(x, y), footprint.body).masked(ranges)
    half_length, half_width = footprint.half_length + OUTLINE_MARGIN, footprint.half_width + OUTLINE_MARGIN
    outline = (
        shapely.Point(0, 0).buffer(half_length, quad_segs=512)
        if footprint.is_circle
        else shapely.box(-half_length, -half_width, half_length, half_width)
    )
    ends = shapely.points(x + ranges * np.cos(SCAN.angles), y + ranges * np.sin(SCAN.angles))
    sure = shapely.distance(outline.exterior, ends) > 1e-5
    np.testing.assert_array_equal(np.isnan(masked)[sure], shapely.contains(outline, ends)[sure])
    np.testing.assert_array_equal(masked[~np.isnan(masked)], ranges[~np.isnan(masked)])


def test_too_close_is_the_robot_itself_where_its_outline_reaches_as_far() -> None:
    near = np.full(SCAN.rays, -np.inf)
    assert np.isnan(Placement(SCAN, body=ROBOMASTER_EP.body).masked(near)).all()
    far = replace(SCAN, range_min=0.18)
    masked = Placement(far, body=ROBOMASTER_EP.body).masked(near)
    np.testing.assert_array_equal(
        np.isnan(masked),
        np.minimum(
            0.17 / np.maximum(np.abs(np.cos(SCAN.angles)), 1e-12), 0.13 / np.maximum(np.abs(np.sin(SCAN.angles)), 1e-12)
        )
        >= 0.18,
    )


@given(st.floats(-720, 720), st.floats(1, 358))
def test_a_blind_sector_reaches_counter_clockwise_from_one_angle_to_the_other(begin: float, width: float) -> None:
    blind = Mounting(blind_sectors=((begin, begin + width),)).blinds(SCAN.angles)
    middle = math.radians(begin + width / 2)
    apart = np.abs(np.remainder(SCAN.angles - middle + np.pi, 2 * np.pi) - np.pi)
    sure = np.abs(apart - math.radians(width / 2)) > 1e-9
    np.testing.assert_array_equal(blind[sure], (apart < math.radians(width / 2))[sure])


def test_sectors_are_read_and_bad_mountings_refused() -> None:
    assert read_sectors("170:190  -10:1e1") == ((170.0, 190.0), (-10.0, 10.0))
    assert read_sectors("") == ()
    for text in ("170", "a:b", "1:2:3", "170-190"):
        with pytest.raises(ConfigurationError, match="FROM:TO"):
            read_sectors(text)
    for sectors in (((0.0, 360.0),), ((5.0, 5.0),), ((math.nan, 1.0),), ((0.0, 200.0), (180.0, 10.0))):
        with pytest.raises(ConfigurationError, match="blind sector"):
            Mounting(blind_sectors=sectors)
    for values in ({"x": math.inf}, {"y": math.nan}, {"yaw": math.inf}):
        with pytest.raises(ConfigurationError, match="finite"):
            Mounting(**values)


@settings(deadline=None, max_examples=40)
@given(st.floats(-0.25, 0.25), st.floats(-0.25, 0.25), st.integers(0, 2**32 - 1))
def test_rays_of_a_mounted_lidar_begin_where_it_is(x: float, y: float, seed: int) -> None:
    """Shapely's intersection of each ray with the other robots and a wall."""
    rng = np.random.default_rng(seed)
    scan = ScanConfig(rays=60, range_min=0.0, range_max=3.0)
    poses = rng.uniform((-2, -2, -3), (2, 2, 3), (1, 4, 3))
    poses[0, 0, :2] = 0.3, -0.2
    arena = Arena(walls=np.array([[-2.5, -2.5, 2.5, -2.4]]))
    cast = cast_scans(poses, np.ones((1, 4), bool), ROBOMASTER_EP, arena, scan, eye=(x, y))[0, 0]
    boxes = [
        affinity.translate(affinity.rotate(shapely.box(-0.16, -0.12, 0.16, 0.12), h, (0, 0), use_radians=True), px, py)
        for px, py, h in poses[0, 1:]
    ]
    solid = shapely.union_all([*boxes, shapely.LineString([(-2.5, -2.5), (2.5, -2.4)])])
    px, py, heading = poses[0, 0]
    eye = (px + math.cos(heading) * x - math.sin(heading) * y, py + math.sin(heading) * x + math.cos(heading) * y)
    for angle, found in zip(heading + scan.angles, cast, strict=True):
        end = (eye[0] + 3 * math.cos(angle), eye[1] + 3 * math.sin(angle))
        hit = shapely.distance(shapely.Point(eye), shapely.LineString([eye, end]).intersection(solid))
        assert found == pytest.approx(hit if not math.isnan(hit) else math.inf, abs=1e-6) or hit > 2.999


@settings(deadline=None, max_examples=40)
@given(st.floats(-0.15, 0.15), st.floats(-0.15, 0.15), st.integers(0, 2**32 - 1))
def test_from_the_base_a_mounted_lidar_sees_what_one_at_the_centre_sees(x: float, y: float, seed: int) -> None:
    """Three pillars apart from each other: ranges agree but for rays at their rims."""
    rng = np.random.default_rng(seed)
    bearings = rng.uniform(-3, 3) + np.array([0, 2.1, 4.2]) + rng.uniform(-0.3, 0.3, 3)
    pillars = np.stack([*(rng.uniform(0.6, 1.7, 3) * (np.cos(bearings), np.sin(bearings))), np.full(3, 0.15)], axis=-1)
    poses, active, arena = np.zeros((1, 1, 3)), np.ones((1, 1), bool), Arena(pillars=pillars)
    wide = replace(SCAN, range_max=2.0 + math.hypot(x, y))
    eye = cast_scans(poses, active, ROBOMASTER_EP, arena, wide, eye=(x, y))
    seen = Placement(SCAN, Mounting(x, y)).from_base(eye)[0][0, 0]
    centre = cast_scans(poses, active, ROBOMASTER_EP, arena, SCAN)[0, 0]
    # Of a pillar the mounted LiDAR sees other ends of the near side, up to its parallax there.
    around = np.isfinite(centre)
    rim = np.zeros(SCAN.rays, bool)
    for shift in range(-12, 13):
        rim |= np.roll(around, shift) != around
    np.testing.assert_array_equal(np.isfinite(seen)[~rim], around[~rim])
    clear = around & ~rim
    np.testing.assert_allclose(seen[clear], centre[clear], atol=0.02)


@pytest.mark.parametrize("profile", [IDEAL, HARDWARE], ids=["ideal", "hardware"])
def test_a_world_with_a_mounting_shows_what_its_driver_would_show(profile: object) -> None:
    """Blind sectors are unknown, the rest is as without; a LiDAR off the centre sees the same team."""
    assert isinstance(profile, type(IDEAL))
    poses = np.array([[[0.0, 0.0, 0.3], [1.0, 0.1, 2.0], [0.2, 0.9, -1.0]]])
    sectors = Mounting(blind_sectors=((80.0, 100.0), (200.0, 210.0)))
    views = []
    for mounting in (Mounting(), sectors, Mounting(0.1, -0.05)):
        world = World(poses, replace(profile, mounting=mounting), seeds=[4])
        world.apply(np.zeros((1, 3, 3)), 1.0)
        views.append(world.observe().scans.ranges)
        assert world.observe().scans.config == profile.lidar.scan
    plain, blind, aside = views
    hidden = sectors.blinds(profile.lidar.scan.angles)
    assert np.isnan(blind[..., hidden]).all()
    np.testing.assert_array_equal(blind[..., ~hidden], plain[..., ~hidden])
    assert (np.isfinite(plain) != np.isfinite(aside)).mean() < 0.05
    both = np.isfinite(plain) & np.isfinite(aside)
    assert np.median(np.abs(plain[both] - aside[both])) < 0.03


@pytest.mark.parametrize("name", ["turtlebot4", "turtlebot3-burger-lds01", "ideal"])
def test_views_from_the_lidar_are_what_placement_makes_views_from_the_base_of(name: str) -> None:
    poses = np.array([[[0.0, 0.0, 0.3], [1.0, 0.1, 2.0], [0.2, 0.9, -1.0]]])
    profile = get_profile(name)
    raw, placed = (World(poses, profile, seeds=[4], from_lidar=each) for each in (True, False))
    for world in (raw, placed):
        world.apply(np.zeros((1, 3, 3)), 1.0)
    measured, scans = raw.observe().scans, placed.observe().scans
    assert measured.config == profile.from_lidar
    placement = Placement(profile.lidar.scan, profile.mounting)
    np.testing.assert_array_equal(placement.from_base(placement.masked(measured.ranges))[0], scans.ranges)
