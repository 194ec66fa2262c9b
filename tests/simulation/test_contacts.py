"""Overlaps of footprints, walls and pillars against Shapely."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from shapely import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from triform.simulation import IDEAL, ROBOMASTER_EP, Arena, Composition, Footprint, Profile, World

Array = NDArray[np.float64]
DISC = Footprint.circle(0.3)


def _shape(pose: Array, footprint: Footprint) -> BaseGeometry:
    if footprint.is_circle:
        return Point(pose[:2])
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return Polygon(footprint.corners @ np.array([[cos, sin], [-sin, cos]]) + pose[:2])


def _depth(first: BaseGeometry, second: BaseGeometry, reach: float) -> float:
    """Positive if two shapes, swollen by ``reach`` together, overlap; their distance decides."""
    return reach - float(first.distance(second))


@pytest.mark.parametrize("footprint", [ROBOMASTER_EP, DISC], ids=["box", "circle"])
def test_robots_match_shapely(footprint: Footprint) -> None:
    rng = np.random.default_rng(1)
    poses = rng.uniform([-0.35, -0.35, -np.pi], [0.35, 0.35, np.pi], (600, 2, 3))
    reach = 2 * footprint.half_length if footprint.is_circle else 0.0
    world = World(poses, Profile("test", footprint=footprint))
    counts = [0, 0]
    for pair, collided in zip(poses, world.collided, strict=True):
        first, second = (_shape(pose, footprint) for pose in pair)
        expected = _depth(first, second, reach) > 0 if footprint.is_circle else first.intersection(second).area > 0
        assert collided == expected
        counts[int(expected)] += 1
    assert min(counts) > 100
    np.testing.assert_allclose(world.min_distance, np.linalg.norm(poses[:, 0, :2] - poses[:, 1, :2], axis=1))


SMALL, LONG, WIDE = Footprint.circle(0.2), Footprint.box(0.5, 0.1), Footprint.circle(0.5)


@pytest.mark.parametrize("pair", [(DISC, WIDE), (ROBOMASTER_EP, SMALL), (WIDE, LONG), (LONG, ROBOMASTER_EP)])
def test_robots_of_two_kinds_match_shapely(pair: tuple[Footprint, Footprint]) -> None:
    poses = np.random.default_rng(3).uniform([-0.4, -0.4, -np.pi], [0.4, 0.4, np.pi], (600, 2, 3))
    kinds = tuple(Profile("test", footprint=footprint) for footprint in pair)
    arena = Arena("arena", np.array([[0.3, -2, 0.3, 2]]), np.array([[-0.3, 0.0, 0.1]]))
    world = World(poses, Composition(kinds, (1, 1)), arena)
    reaches = [footprint.half_length if footprint.is_circle else 0.0 for footprint in pair]
    counts = [0, 0]
    for robots, collided, hit in zip(poses, world.collided, world.hit_arena, strict=True):
        shapes = [_shape(pose, footprint) for pose, footprint in zip(robots, pair, strict=True)]
        both_boxes = sum(reaches) == 0
        expected = shapes[0].intersects(shapes[1]) if both_boxes else _depth(*shapes, sum(reaches)) > 0
        assert collided == expected
        obstacles = (LineString([(0.3, -2), (0.3, 2)]), 0.0), (Point(-0.3, 0.0), 0.1)
        assert hit == any(
            _depth(shape, obstacle, reach + own) > 0 or (reach + own == 0 and shape.intersects(obstacle))
            for shape, reach in zip(shapes, reaches, strict=True)
            for obstacle, own in obstacles
        )
        counts[int(collided)] += 1
    assert min(counts) > 50


@pytest.mark.parametrize("footprint", [ROBOMASTER_EP, DISC], ids=["box", "circle"])
def test_walls_and_pillars_match_shapely(footprint: Footprint) -> None:
    rng = np.random.default_rng(2)
    own = footprint.half_length if footprint.is_circle else 0.0
    counts = [0, 0]
    for _ in range(50):
        wall = rng.uniform(-1, 1, 4)
        pillar = np.array([*rng.uniform(-1, 1, 2), rng.uniform(0.01, 0.3)])
        poses = rng.uniform([-1, -1, -np.pi], [1, 1, np.pi], (20, 1, 3))
        for arena, solid, reach in [
            (Arena("wall", wall[None]), LineString(wall.reshape(2, 2)), own),
            (Arena(pillars=pillar[None]), Point(pillar[:2]), own + pillar[2]),
        ]:
            hit = World(poses, Profile("test", footprint=footprint), arena).hit_arena
            for pose, found in zip(poses[:, 0], hit, strict=True):
                shape = _shape(pose, footprint)
                expected = shape.intersects(solid) if reach == 0.0 else _depth(shape, solid, reach) > 0
                assert found == expected
                counts[int(expected)] += 1
    assert min(counts) > 100


def test_touching_is_no_overlap_and_passing_is_recorded_for_good() -> None:
    touching = np.array([[[0.0, 0, 0], [0.32, 0, 0]]])
    assert not World(touching, IDEAL).collided[0]
    assert World(touching - [[[0, 0, 0], [1e-9, 0, 0]]], IDEAL).collided[0]
    world = World(np.array([[[0.0, 0, 0], [1.0, 0, np.pi]], [[0.0, 0, 0], [0.0, 1.0, 0]]]), IDEAL)
    commands = np.zeros((2, 2, 3))
    commands[:, :, 0] = 0.5
    for _ in range(30):
        world.apply(commands, 0.1)
    # Head-on, they meet after 1 s and pass through each other; side by side, nothing happens.
    np.testing.assert_array_equal(world.collided, [True, False])
    assert world.min_distance[0] < 0.01
    assert world.min_distance[1] == pytest.approx(1.0)
    np.testing.assert_allclose(world.poses[0, :, 0], [1.5, -0.5], atol=1e-12)


def test_absent_robots_touch_nothing() -> None:
    poses = np.zeros((1, 3, 3))
    active = np.array([[True, False, False]])
    world = World(poses, IDEAL, Arena.open(), active=active)
    assert not world.collided[0]
    assert world.min_distance[0] == np.inf
