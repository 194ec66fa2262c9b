from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from triform.control import GnnController, make_controller
from triform.policy import GnnConfig, GnnRuntime, PolicySpec, hear
from triform.policy.export import export_policy
from triform.policy.gnn import GraphNetwork
from triform.policy.weights import save_policy
from triform.simulation import World, get_profile, sample_starts
from triform.threads import limit_threads
from triform.types import ConfigurationError, MapConfig, PrivilegedView, ScanConfig, TriformError, View

SPEC = PolicySpec(
    GnnConfig(dim=12, rounds=2, mlp=16), ScanConfig(), MapConfig(), distances=(0.6, 1.5), rest_speed=0.02,
    least_push=0.05,
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gnn") / "small"
    torch.manual_seed(1)
    save_policy(path, GraphNetwork(SPEC.network), SPEC)
    poses = sample_starts(9, 1, seed=0)[0]
    export_policy(path, hear(poses, np.array([0, 9]), np.array([0.14]), 2.1))
    return path


def view_of(robots: int, runs: int, seed: int) -> PrivilegedView:
    view = World(sample_starts(robots, runs, seed), get_profile("ideal")).observe()
    noise = np.random.default_rng(seed).standard_normal((runs, robots, 2))
    return replace(view, noise=noise)


def test_commands_are_the_networks_answers_with_pushes_and_rest(folder: Path) -> None:
    view, runtime = view_of(7, 1, 3), GnnRuntime(folder)
    commands = GnnController(runtime).command(view)
    answers = runtime.commands(hear(view.poses[0], np.array([0, 7]), np.array([0.14]), 2.1))
    pushed = answers[:, :2] + np.where(answers[:, 3:] > 0.05, answers[:, 3:], 0.0) * view.noise[0]
    pushed[np.linalg.norm(pushed, axis=1) < 0.02] = 0.0
    np.testing.assert_allclose(commands[0, :, :2], pushed, atol=1e-9)


def test_lengths_scale_with_the_distance(folder: Path) -> None:
    view, runtime = view_of(6, 4, 1), GnnRuntime(folder)
    smaller = replace(view, poses=view.poses * (0.8, 0.8, 1.0))
    full = GnnController(runtime, blocking_radius=0.2).command(view)
    scaled = GnnController(runtime, 0.8, 0.16).command(smaller)
    np.testing.assert_allclose(scaled[..., :2], 0.8 * full[..., :2], atol=1e-5)
    with pytest.raises(ConfigurationError, match="trained for distances"):
        GnnController(runtime, 2.0)


def test_worlds_and_threads_do_not_matter(folder: Path) -> None:
    view, controller = view_of(7, 90, 2), GnnController(GnnRuntime(folder))
    with limit_threads(1):
        alone = controller.command(view)
    with limit_threads(3):
        np.testing.assert_array_equal(controller.command(view), alone)
    for b in (0, 41, 89):
        one = replace(
            view, scans=replace(view.scans, ranges=view.scans.ranges[[b]]), active=view.active[[b]],
            poses=view.poses[[b]], noise=view.noise[[b]], odometry=None,
        )  # fmt: skip
        np.testing.assert_array_equal(controller.command(one)[0], alone[b])


def test_robots_that_are_not_there_are_not_heard(folder: Path) -> None:
    view, controller = view_of(6, 1, 4), GnnController(GnnRuntime(folder))
    poses, active = view.poses.copy(), view.active.copy()
    poses[0, 2], active[0, 2] = np.nan, False
    commands = controller.command(replace(view, poses=poses, active=active))
    assert not commands[0, 2].any()
    rest = [0, 1, 3, 4, 5]
    fewer = replace(
        view, scans=replace(view.scans, ranges=view.scans.ranges[:, rest]), active=view.active[:, rest],
        poses=view.poses[:, rest], noise=view.noise[:, rest], odometry=None,
    )  # fmt: skip
    np.testing.assert_array_equal(controller.command(fewer)[0], commands[0, rest])


def test_it_is_made_by_name_and_needs_poses(folder: Path) -> None:
    controller = make_controller(f"gnn:{folder}")
    view = view_of(4, 2, 0)
    assert controller.privileged
    assert controller.description["name"] == "gnn"
    assert controller.description["network"]["kind"] == "gnn"
    commands = controller.command(view)
    assert commands.shape == (2, 4, 3)
    assert commands.any()
    with pytest.raises(TriformError, match="needs true poses"):
        controller.command(View(view.scans, view.active, 0.0))
    with pytest.raises(TriformError, match="poses of active robots must be finite"):
        controller.command(replace(view, poses=np.full_like(view.poses, np.nan)))
    with pytest.raises(ConfigurationError, match="reads no occupancy maps"):
        make_controller(f"policy:{folder}")
    with pytest.raises(ConfigurationError, match="a graph network is needed"):
        make_controller("gnn:default")
