"""The expert on large teams: by cells, on any number of threads, and for many worlds at once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.control import Expert, Springs, Teacher, expert_into
from triform.control import expert as expert_module
from triform.geometry.cells import SMALL_TEAM
from triform.threads import limit_threads
from triform.types import PrivilegedView, Scan, ScanConfig


def view(poses: np.ndarray, active: np.ndarray) -> PrivilegedView:
    return PrivilegedView(Scan(np.full((*active.shape, 1), np.inf), ScanConfig(rays=1)), active, 0.0, poses)


def team(seed: int, worlds: int, robots: int, gridded: bool) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 5 * np.sqrt(robots / 13), (worlds, robots, 2))
    if gridded:
        places = np.round(places)
    poses = np.concatenate([places, rng.uniform(-np.pi, np.pi, (worlds, robots, 1))], axis=-1)
    active = rng.random((worlds, robots)) < 0.9
    poses[~active] = np.nan
    return poses, active


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(SMALL_TEAM + 1, 70), st.sampled_from([0.9, 2.0, np.inf]), st.booleans())
def test_cells_change_no_bit_of_a_command(seed: int, robots: int, reach: float, gridded: bool) -> None:
    poses, active = team(seed, 1, robots, gridded)
    expected, graph = np.empty_like(poses[0]), np.empty((robots, robots), dtype=bool)
    expert_into(poses[0], active[0], Springs(1.0, 1.0, 0.8, 1.0, reach), graph, expected)
    command = Expert(sensing_range=reach, odd_gain=0.8).command(view(poses, active))[0]
    np.testing.assert_array_equal(command, expected)
    springs = np.zeros((robots, 2))
    for i, j in np.argwhere(graph):
        gap = poses[0, j, :2] - poses[0, i, :2]
        length = np.linalg.norm(gap)
        if length > 0:
            springs[i] += (length - 1.0) / length * (gap + 0.8 * np.array([-gap[1], gap[0]]))
    speed = np.linalg.norm(springs, axis=1)
    np.testing.assert_allclose(np.linalg.norm(command, axis=1)[active[0]], np.minimum(speed, 1.0)[active[0]], atol=1e-9)


@pytest.mark.parametrize(("worlds", "robots"), [(1, 3000), (5, 100), (5, 8)])
def test_neither_threads_nor_the_batch_matter(worlds: int, robots: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expert_module, "ROBOTS_PER_THREAD", 1)
    poses, active = team(1, worlds, robots, False)
    with limit_threads(1):
        expected = Expert().command(view(poses, active))
    with limit_threads(3):
        np.testing.assert_array_equal(Expert().command(view(poses, active)), expected)
    for b in range(worlds):
        np.testing.assert_array_equal(Expert().command(view(poses[b : b + 1], active[b : b + 1]))[0], expected[b])
    everybody = np.nan_to_num(poses)
    np.testing.assert_array_equal(
        Teacher("expert").label(everybody), Expert().command(view(everybody, np.ones_like(active)))
    )
