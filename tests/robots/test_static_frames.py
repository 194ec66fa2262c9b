"""Chains of transforms against SciPy's rotations, and the mountings that they tell."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from triform.robots.frames import MOST_TILT, FrameTree, mounting_of
from triform.robots.laser_scan import LaserScan
from triform.types import ConfigurationError

seeds = st.integers(0, 2**32 - 1)


def random_pose(rng: np.random.Generator) -> RigidTransform:
    return RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))


def add(tree: FrameTree, parent: str, child: str, pose: RigidTransform) -> None:
    tree.add(parent, child, pose.translation, pose.rotation.as_quat())


@given(seeds)
def test_a_chain_is_the_product_of_its_transforms_through_the_nearest_common_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shell, lidar, arm, base = (random_pose(rng) for _ in range(4))
    tree = FrameTree()
    # In the order of messages, not of the chain: root -> base -> shell -> lidar, and root -> arm.
    add(tree, "shell", "lidar", lidar)
    add(tree, "root", "base", base)
    add(tree, "root", "arm", arm)
    add(tree, "base", "shell", random_pose(rng))
    add(tree, "base", "shell", shell)
    np.testing.assert_allclose(tree.pose("lidar", "base"), (shell * lidar).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(tree.pose("base", "lidar"), (shell * lidar).inv().as_matrix(), atol=1e-9)
    np.testing.assert_allclose(tree.pose("lidar", "arm"), (arm.inv() * base * shell * lidar).as_matrix(), atol=1e-9)
    np.testing.assert_array_equal(tree.pose("lidar", "lidar"), np.eye(4))
    assert tree.pose("lidar", "elsewhere") is None


def test_frames_in_a_circle_end_the_search() -> None:
    tree = FrameTree()
    add(tree, "a", "b", RigidTransform.identity())
    add(tree, "b", "a", RigidTransform.identity())
    assert tree.pose("b", "c") is None


@given(st.floats(-math.pi, math.pi), st.booleans(), st.floats(-MOST_TILT, MOST_TILT), seeds)
def test_rays_point_where_their_frame_says(yaw: float, upright: bool, tilt: float, seed: int) -> None:
    """A ray's direction in the base, by the mounting, is that of its vector under the transform."""
    rng = np.random.default_rng(seed)
    flip = Rotation.from_euler("x", 0.0 if upright else math.pi)
    level = Rotation.from_euler("z", yaw) * flip
    place = rng.normal(size=3)
    mounting = mounting_of(RigidTransform.from_components(place, level).as_matrix())
    assert (mounting.x, mounting.y, mounting.upright) == (place[0], place[1], upright)
    scan = LaserScan(np.ones(9, np.float32), -1.0, 3.0, 0.5, 0.1, 8.0).mounted(mounting)
    for k in range(9):
        own, seen = -1.0 + 0.5 * k, scan.angle_min + k * scan.angle_increment
        vector = level.apply([math.cos(own), math.sin(own), 0.0])
        np.testing.assert_allclose([math.cos(seen), math.sin(seen), 0.0], vector, atol=1e-9)
    leaning = RigidTransform.from_rotation(level * Rotation.from_euler("y", 0.99 * tilt))
    assert mounting_of(leaning.as_matrix()).upright == upright


@pytest.mark.parametrize("tilt", [0.1, 1.0, math.pi / 2, math.pi - 0.1])
def test_a_tilted_lidar_is_refused(tilt: float) -> None:
    pose = RigidTransform.from_rotation(Rotation.from_euler("y", tilt)).as_matrix()
    with pytest.raises(ConfigurationError, match="is tilted by"):
        mounting_of(pose)


@pytest.mark.parametrize(
    ("place", "turn"),
    [
        ([0, 0, 0], [0, 0, 0, 0]),
        ([0, 0, 0], [1, 0, 0, 1]),
        ([0, math.nan, 0], [0, 0, 0, 1]),
        ([0, 0, 0], [0, 0, 0, math.nan]),
    ],
)
def test_what_is_no_pose_is_refused(place: list[float], turn: list[float]) -> None:
    with pytest.raises(ConfigurationError, match="quaternion of length 1"):
        FrameTree().add("base", "lidar", place, turn)
