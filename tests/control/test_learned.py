from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from triform.control import CONTROLLERS, LearnedPolicy, make_controller, shipped_weights
from triform.perception import occupancy_maps
from triform.policy import PolicyRuntime, pack
from triform.simulation import World, get_profile, starts
from triform.threads import limit_threads
from triform.types import ConfigurationError, MapConfig, Scan, ScanConfig, TriformError, View

WEIGHTS = sorted(shipped_weights())


@pytest.fixture(scope="module", params=WEIGHTS)
def policy(request: pytest.FixtureRequest) -> LearnedPolicy:
    return LearnedPolicy(PolicyRuntime(shipped_weights()[request.param]))


def test_weights_are_shipped() -> None:
    assert {"default", "large"} <= set(WEIGHTS)
    for folder in shipped_weights().values():
        assert {file.name for file in folder.iterdir()} == {
            "README.md",
            "model.json",
            "model.onnx",
            "model.safetensors",
        }
        assert sum(file.stat().st_size for file in folder.iterdir()) <= 8e6
        assert "triform train" in (folder / "README.md").read_text(encoding="utf-8")


def test_every_robot_is_driven_by_its_own_scan_alone(policy: LearnedPolicy) -> None:
    view = World(starts(6, 3, seed=1), get_profile("ideal")).observe()
    together = policy.command(view)
    assert together.shape == (3, 6, 3)
    for b in range(3):
        for n in range(6):
            own = View(
                Scan(view.scans.ranges[b : b + 1, n : n + 1], view.scans.config), np.ones((1, 1), dtype=bool), 0.0
            )
            np.testing.assert_array_equal(policy.command(own)[0, 0], together[b, n])


def test_commands_are_the_same_with_any_number_of_threads(policy: LearnedPolicy) -> None:
    view = World(starts(7, 90, seed=1), get_profile("ideal")).observe()
    with limit_threads(1):
        alone = policy.command(view)
    with limit_threads(3):
        np.testing.assert_array_equal(policy.command(view), alone)


def test_algorithm_2_is_scan_map_network(policy: LearnedPolicy) -> None:
    view = World(starts(5, 1, seed=2), get_profile("ideal")).observe()
    maps = occupancy_maps(view.scans, MapConfig())[0]
    runtime = PolicyRuntime(shipped_weights()["default"])
    np.testing.assert_allclose(LearnedPolicy(runtime).command(view)[0], runtime.commands(pack(maps, 10)), atol=1e-6)


def test_ranges_of_any_value_give_a_defined_command(policy: LearnedPolicy) -> None:
    """What is no range in (0, range_max] counts as no return."""
    view = World(starts(5, 1, seed=4), get_profile("ideal")).observe()
    ranges = view.scans.ranges.copy()
    expected = policy.command(view)
    nothing = ~np.isfinite(ranges)
    for value in (np.nan, -np.inf, -1.0, 0.0, 2.5, np.inf):
        spoilt = np.where(nothing, value, ranges)
        commands = policy.command(View(Scan(spoilt, view.scans.config), view.active, 0.0))
        np.testing.assert_array_equal(commands, expected)
    blind = policy.command(View(Scan(np.full_like(ranges, np.nan), view.scans.config), view.active, 0.0))
    assert np.isfinite(blind).all()
    np.testing.assert_array_equal(blind[0], np.broadcast_to(blind[0, 0], (5, 3)))


@pytest.mark.parametrize(
    ("ranges", "says"),
    [
        (np.zeros((1, 1, 449)), "450 rays"),
        (np.zeros((1, 1, 451)), "450 rays"),
        (np.zeros(450), r"\(B, N, R\)"),
        (np.zeros((1, 2, 450)), r"\(B, N, R\)"),
        (np.array([[[1.0] * 450]], dtype=object), "floating point"),
        (np.zeros((1, 1, 450), dtype=np.int64), "floating point"),
        ([[[1.0] * 450]], "an array is needed"),
    ],
)
def test_scans_of_another_form_are_refused(ranges: np.ndarray, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        View(Scan(ranges, ScanConfig()), np.ones((1, 1), dtype=bool), 0.0)


def test_inactive_robots_get_zero_and_a_lone_robot_stands_still(policy: LearnedPolicy) -> None:
    scans = Scan(np.full((1, 2, 450), np.inf), ScanConfig())
    commands = policy.command(View(scans, np.array([[True, False]]), 0.0))
    assert not commands[0, 1].any()
    assert np.linalg.norm(commands[0, 0]) < 0.2


def test_two_robots_take_the_prescribed_distance(policy: LearnedPolicy) -> None:
    poses = np.array([[[0.0, 0, 0.3], [1.6, 0.2, -2.0]], [[0.0, 0, 1.0], [0.6, 0.1, 2.0]]])
    world = World(poses, get_profile("ideal"))
    for _ in range(200):
        world.apply(policy.command(world.observe()), 0.1)
    distance = np.linalg.norm(world.poses[:, 0, :2] - world.poses[:, 1, :2], axis=1)
    np.testing.assert_allclose(distance, 1.0, atol=0.05)


def test_other_settings_are_refused(policy: LearnedPolicy) -> None:
    view = View(Scan(np.zeros((1, 1, 90)), ScanConfig(rays=90)), np.ones((1, 1), dtype=bool), 0.0)
    with pytest.raises(ConfigurationError, match="rays"):
        policy.command(view)
    with pytest.raises(ConfigurationError, match=r"distance of 1\.0 m"):
        make_controller("policy", distance=0.8)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_controller_commands_a_world(name: str) -> None:
    world = World(starts(4, 2, seed=3), get_profile("ideal"))
    controller = make_controller(name)
    commands = controller.command(world.observe())
    assert commands.shape == (2, 4, 3)
    assert np.isfinite(commands).all()
    assert commands.any()
    assert controller.description["name"] == name
    assert controller.privileged == name.startswith("expert")


def test_unknown_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="no controller 'magic'"):
        make_controller("magic")
    with pytest.raises(ConfigurationError, match="no policy 'nowhere'"):
        make_controller("policy", weights="nowhere")
    with pytest.raises(ConfigurationError, match="no weights"):
        make_controller("expert", weights="default")
    with pytest.raises(TriformError, match="holds no policy"):
        make_controller("policy", weights=str(tmp_path))
