from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from triform.control import CONTROLLERS, LearnedPolicy, make_controller, shipped_weights
from triform.control.registry import WITH_WEIGHTS
from triform.perception import occupancy_maps
from triform.policy import NetworkConfig, PackedMaps, PolicyRuntime, PolicySpec, pack, read_spec
from triform.policy.export import export_policy
from triform.policy.vit import VisionTransformer
from triform.policy.weights import save_policy
from triform.simulation import IDEAL, Footprint, Profile, World, sample_starts
from triform.threads import limit_threads
from triform.types import ConfigurationError, FloatArray, MapConfig, Scan, ScanConfig, TriformError, View

#: Policies that drive robots by their own scans.
WEIGHTS = [name for name, folder in sorted(shipped_weights().items()) if hasattr(read_spec(folder).network, "patch")]
SMALL = PolicySpec(
    NetworkConfig(dim=16, depth=1, heads=2, mlp=16, outputs=4), ScanConfig(), MapConfig(), distances=(0.5, 1.5)
)


@pytest.fixture(scope="module", params=WEIGHTS)
def policy(request: pytest.FixtureRequest) -> LearnedPolicy:
    return LearnedPolicy(PolicyRuntime(shipped_weights()[request.param]))


def ideal_for(policy: LearnedPolicy) -> Profile:
    """Ideal robots whose LiDAR reaches as far as a policy looks."""
    return IDEAL.seeing(read_spec(shipped_weights()[policy.description["weights"]]).scan.range_max)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> PolicyRuntime:
    """A small network whose answers depend on everything in its maps."""
    folder = tmp_path_factory.mktemp("policy") / "small"
    torch.manual_seed(0)
    network = VisionTransformer(SMALL.network)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    save_policy(folder, network, SMALL)
    export_policy(folder, (np.random.default_rng(0).random((10, 100, 100)) < 0.03).astype(np.uint8))
    return PolicyRuntime(folder)


class Answers:
    """Stands for a loaded policy, and answers what it is told to."""

    folder = Path("answers")

    def __init__(self, answers: object, **spec: object) -> None:
        self._answers = np.array(answers, dtype=float)
        network = replace(SMALL.network, outputs=self._answers.shape[1])
        self.spec = replace(SMALL, **{"network": network, **spec})

    def commands(self, packed: PackedMaps) -> FloatArray:
        assert len(packed.counts) == len(self._answers)
        return self._answers.copy()


def blank_view(robots: int, noise: np.ndarray | None = None, reach: float = 2.0) -> View:
    scans = Scan(np.full((1, robots, 450), np.inf), ScanConfig(range_max=reach))
    return View(scans, np.ones((1, robots), dtype=bool), 0.0, noise=None if noise is None else noise[None])


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
    view = World(sample_starts(6, 3, seed=1), ideal_for(policy)).observe()
    together = policy.command(view)
    assert together.shape == (3, 6, 3)
    for b in range(3):
        for n in range(6):
            here = (slice(b, b + 1), slice(n, n + 1))
            own = View(
                Scan(view.scans.ranges[here], view.scans.config), view.active[here], 0.0,
                noise=view.noise[here], odometry=view.odometry[here],
            )  # fmt: skip
            np.testing.assert_array_equal(policy.command(own)[0, 0], together[b, n])


def test_commands_are_the_same_with_any_number_of_threads(policy: LearnedPolicy) -> None:
    view = World(sample_starts(7, 90, seed=1), ideal_for(policy)).observe()
    with limit_threads(1):
        alone = policy.command(view)
    with limit_threads(3):
        np.testing.assert_array_equal(policy.command(view), alone)


def test_algorithm_2_is_scan_map_network(policy: LearnedPolicy) -> None:
    view = replace(World(sample_starts(5, 1, seed=2), ideal_for(policy)).observe(), noise=None)
    runtime = PolicyRuntime(shipped_weights()[policy.description["weights"]])
    maps = occupancy_maps(view.scans, runtime.spec.map)[0]
    answers = runtime.commands(pack(maps, runtime.spec.network.patch, runtime.spec.network.attention))[:, :3]
    answers[np.linalg.norm(answers[:, :2], axis=1) < runtime.spec.rest_speed] = 0.0
    np.testing.assert_allclose(policy.command(view)[0], answers, atol=1e-6)


def test_ranges_of_any_value_give_a_defined_command(policy: LearnedPolicy) -> None:
    """What is no range in (0, range_max] counts as no return."""
    view = World(sample_starts(5, 1, seed=4), ideal_for(policy)).observe()
    ranges = view.scans.ranges.copy()
    expected = policy.command(replace(view, noise=None, odometry=None))
    nothing = ~np.isfinite(ranges)
    for value in (np.nan, -np.inf, -1.0, 0.0, 3.5, np.inf):
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
        (np.array([[[1.0] * 450]], dtype=object), "numbers are needed"),
        (np.zeros((1, 1, 450), dtype=bool), "numbers are needed"),
        ([[[1.0] * 450, [1.0]]], "one length"),
    ],
)
def test_scans_of_another_form_are_refused(ranges: np.ndarray, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        View(Scan(ranges, ScanConfig()), np.ones((1, 1), dtype=bool), 0.0)


def test_inactive_robots_get_zero_and_a_lone_robot_stands_still(policy: LearnedPolicy) -> None:
    scans = Scan(np.full((1, 2, 450), np.inf), ideal_for(policy).lidar.scan)
    commands = policy.command(View(scans, np.array([[True, False]]), 0.0))
    assert not commands[0, 1].any()
    assert np.linalg.norm(commands[0, 0]) < 0.2


def test_two_robots_take_the_prescribed_distance(policy: LearnedPolicy) -> None:
    poses = np.array([[[0.0, 0, 0.3], [1.6, 0.2, -2.0]], [[0.0, 0, 1.0], [0.6, 0.1, 2.0]]])
    world = World(poses, ideal_for(policy))
    for _ in range(200):
        world.apply(policy.command(world.observe()), 0.1)
    distance = np.linalg.norm(world.poses[:, 0, :2] - world.poses[:, 1, :2], axis=1)
    # The convolutional baseline was trained for a short time.
    np.testing.assert_allclose(distance, 1.0, atol=0.1 if policy.description["weights"] == "cnn" else 0.05)


def test_other_settings_are_refused(policy: LearnedPolicy, small: PolicyRuntime) -> None:
    reach = ideal_for(policy).lidar.scan.range_max
    for config, says in (
        (ScanConfig(rays=90, range_max=reach), "90 rays"),
        (ScanConfig(range_max=reach - 0.1), f"sensing range of {reach:g} m"),
    ):
        view = View(Scan(np.zeros((1, 1, config.rays)), config), np.ones((1, 1), dtype=bool), 0.0)
        with pytest.raises(ConfigurationError, match=says):
            policy.command(view)
    for distance in (0.49, 1.51, 0.0, np.nan):
        with pytest.raises(ConfigurationError, match=rf"distances of 0\.5 m to 1\.5 m, not {distance} m"):
            LearnedPolicy(small, distance)
    with pytest.raises(ConfigurationError, match=r"distance of 1\.0 m, not 0\.8 m"):
        LearnedPolicy(Answers([[0.0] * 4], distances=None), 0.8)
    for outputs in (1, 2, 5):
        with pytest.raises(ConfigurationError, match=f"gives {outputs} numbers"):
            LearnedPolicy(Answers([[0.0] * outputs]))


def test_of_a_longer_scan_the_range_of_the_training_is_used(policy: LearnedPolicy) -> None:
    poses = sample_starts(6, 2, seed=5)
    short, long = (World(poses, each).observe() for each in (ideal_for(policy), IDEAL.seeing(8.0)))
    assert ((long.scans.ranges > short.scans.config.range_max) & np.isfinite(long.scans.ranges)).any()
    np.testing.assert_array_equal(policy.command(long), policy.command(short))


def test_an_amplitude_pushes_by_as_much_as_the_robot_draws() -> None:
    amplitudes = np.array([-0.3, 0.0, 0.04, 0.05, 0.051, 0.4])
    mean = np.array([0.3, -0.2, 0.1])
    answers = np.concatenate([np.tile(mean, (6, 1)), amplitudes[:, None]], axis=1)
    noise = np.random.default_rng(1).standard_normal((6, 2))
    controller = LearnedPolicy(Answers(answers, least_push=0.05))
    wanted = np.tile(mean, (6, 1))
    np.testing.assert_array_equal(controller.command(blank_view(6))[0], wanted)
    for k in (4, 5):
        wanted[k, :2] += amplitudes[k] * noise[k]
    np.testing.assert_allclose(controller.command(blank_view(6, noise))[0], wanted, atol=1e-15)
    # Without an amplitude there is no noise, and an inactive robot gets none.
    without = LearnedPolicy(Answers(answers[:, :3])).command(blank_view(6, noise))[0]
    np.testing.assert_array_equal(without, answers[:, :3])
    gone = replace(blank_view(7, np.vstack([noise[:3], [[9, 9]], noise[3:]])))
    gone = replace(gone, active=np.array([[True, True, True, False, True, True, True]]))
    np.testing.assert_allclose(controller.command(gone)[0], np.insert(wanted, 3, 0.0, axis=0), atol=1e-15)


def test_slow_commands_are_exact_rest() -> None:
    answers = [
        [0.0, 0.019, 0.5, 0.0],
        [0.0, 0.021, 0.5, 0.0],
        [0.0, 0.019, 0.5, 0.1],
        [0.1, 0.0, 0.5, 0.1],
    ]
    noise = np.array([[9.0, 9.0], [9.0, 9.0], [1.0, 0.0], [-1.0, 0.0]])
    for distance in (0.5, 1.0, 1.5):
        controller = LearnedPolicy(Answers(answers, rest_speed=0.02, least_push=0.05), distance)
        commands = controller.command(blank_view(4, noise, 3.0))[0]
        assert not commands[[0, 3]].any()
        np.testing.assert_allclose(commands[1], [0.0, 0.021 * distance, 0.5])
        np.testing.assert_allclose(commands[2], [0.1 * distance, 0.019 * distance, 0.5])


def scaled(scale: float) -> tuple[Profile, np.ndarray]:
    """Robots, their LiDAR and where they stand, all lengths ``scale`` times as large."""
    scan = ScanConfig(range_min=0.02 * scale, range_max=2.0 * scale)
    profile = replace(IDEAL, footprint=Footprint.box(0.32 * scale, 0.24 * scale), lidar=replace(IDEAL.lidar, scan=scan))
    return profile, sample_starts(7, 4, seed=8) * [scale, scale, 1.0]


@pytest.mark.parametrize("scale", [0.5, 0.8, 1.25])
def test_all_lengths_scale_with_the_distance(small: PolicyRuntime, scale: float) -> None:
    views = []
    for each in (1.0, scale):
        profile, poses = scaled(each)
        world = World(poses, replace(profile, latency=0.15), seeds=range(4))
        # On the way, so that odometry counts.
        for _ in range(4):
            world.apply(np.full((4, 7, 3), [0.2 * each, -0.1 * each, 0.3]), 0.1)
        views.append(world.observe())
    assert views[0].odometry.any(axis=2).all()
    usual, other = LearnedPolicy(small).command(views[0]), LearnedPolicy(small, scale).command(views[1])
    assert np.std(usual, axis=(0, 1)).min() > 1e-3
    if scale == 0.5:
        # Halving rounds nothing.
        np.testing.assert_array_equal(other, usual * [scale, scale, 1.0])
    # Otherwise a return on the edge of a cell may fall into the next one, for one robot of the 28 or so.
    same = np.isclose(other, usual * [scale, scale, 1.0], rtol=0.0, atol=1e-5).all(axis=2)
    assert same.mean() > 0.9
    assert LearnedPolicy(small, scale).description["distance"] == scale


def test_odometry_and_scans_make_the_map(small: PolicyRuntime) -> None:
    """A turn of the robot since its scan, by whole rays, is a turn of the scan."""
    world = World(sample_starts(5, 2, seed=6), IDEAL)
    world.apply(np.full((2, 5, 3), 0.1), 0.1)
    view = replace(world.observe(), noise=None)
    np.testing.assert_array_equal(
        LearnedPolicy(small).command(view), LearnedPolicy(small).command(replace(view, odometry=None))
    )
    odometry = np.zeros((2, 5, 3))
    # A quarter turn maps cells onto cells, but for returns on their edges.
    odometry[..., 2] = np.pi / 2
    finer = replace(IDEAL, lidar=replace(IDEAL.lidar, scan=ScanConfig(rays=600)))
    view = replace(World(sample_starts(5, 2, seed=6), finer).observe(), noise=None)
    turned = Scan(np.roll(view.scans.ranges, -150, axis=-1), view.scans.config)
    found = LearnedPolicy(small).command(replace(view, odometry=odometry))
    np.testing.assert_allclose(found, LearnedPolicy(small).command(replace(view, scans=turned)), atol=1e-5)
    assert not np.allclose(found, LearnedPolicy(small).command(view), atol=1e-2)


def test_one_controller_serves_lidars_in_turn(small: PolicyRuntime) -> None:
    controller, views = LearnedPolicy(small), []
    for rays in (450, 667):
        profile = replace(IDEAL, lidar=replace(IDEAL.lidar, scan=ScanConfig(rays=rays)))
        views.append(World(sample_starts(4, 1, seed=6), profile).observe())
    for view in (*views, *views):
        np.testing.assert_array_equal(controller.command(view), LearnedPolicy(small).command(view))


@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_controller_commands_a_world(name: str) -> None:
    if WITH_WEIGHTS.get(name, "default") not in shipped_weights():
        with pytest.raises(ConfigurationError, match="there is no policy"):
            make_controller(name)
        return
    view = World(sample_starts(4, 2, seed=3), IDEAL.seeing(3.0)).observe()
    controller = make_controller(name)
    commands = controller.command(view)
    assert commands.shape == (2, 4, 3)
    assert np.isfinite(commands).all()
    assert commands.any()
    assert controller.description["name"] == name
    blind = View(view.scans, view.active, view.time, noise=view.noise, odometry=view.odometry)
    if controller.privileged:
        with pytest.raises(TriformError, match="poses"):
            controller.command(blind)
    else:
        np.testing.assert_array_equal(controller.command(blind), commands)


def test_unknown_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="no controller 'magic'"):
        make_controller("magic")
    with pytest.raises(ConfigurationError, match="no policy 'nowhere'"):
        make_controller("policy:nowhere")
    with pytest.raises(ConfigurationError, match="no weights"):
        make_controller("expert:default")
    with pytest.raises(TriformError, match="holds no policy"):
        make_controller(f"policy:{tmp_path}")
