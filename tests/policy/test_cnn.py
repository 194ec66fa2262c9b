from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from triform.policy import CnnConfig, PolicyRuntime, PolicySpec, pack, read_spec
from triform.policy.cnn import ConvolutionalNetwork, dense_maps
from triform.policy.export import export_policy
from triform.policy.gnn_runtime import GnnRuntime
from triform.policy.vit import token_batch
from triform.policy.weights import load_policy, save_policy
from triform.types import ConfigurationError, MapConfig, ScanConfig, TriformError

SMALL = CnnConfig(map_size=20, patch=4, stem=3, channels=6, depth=2, squeeze=4, dim=16, mlp=24)
SPEC = PolicySpec(SMALL, ScanConfig(), MapConfig(size=20, cell=0.2, max_cells=50))


def some_maps(count: int, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.random((count, 20, 20)) < rng.uniform(0, 0.1, (count, 1, 1))).astype(np.uint8)


def network(seed: int = 0) -> ConvolutionalNetwork:
    torch.manual_seed(seed)
    net = ConvolutionalNetwork(SMALL).eval()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return net


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cnn") / "small"
    save_policy(folder, network(), SPEC)
    assert export_policy(folder, some_maps(50)).largest <= 1e-4
    return folder


def test_whole_maps_come_back_from_packed_ones() -> None:
    maps = np.concatenate([some_maps(5), np.zeros((1, 20, 20), np.uint8), some_maps(3, seed=2)])
    whole, owner = dense_maps(token_batch(pack(maps, 4)), SMALL)
    np.testing.assert_array_equal(whole[:, 0].numpy(), maps)
    np.testing.assert_array_equal(np.bincount(owner.numpy(), minlength=9), pack(maps, 4).counts)


def test_the_default_network_has_its_shape_and_size() -> None:
    config = CnnConfig()
    net = ConvolutionalNetwork(config)
    assert 2e5 < sum(parameter.numel() for parameter in net.parameters()) < 3e5
    maps = (np.random.default_rng(0).random((3, 100, 100)) < 0.01).astype(np.uint8)
    packed = pack(maps, config.patch)
    patches, features = net.encode(token_batch(packed))
    assert patches.shape == (len(packed.patches), config.token_width)
    assert features.shape == (3, config.dim)
    assert net(token_batch(packed)).shape == (3, 4)


def test_features_of_a_patch_are_those_of_its_cell() -> None:
    """Without mixing, only cells near a patch decide its features."""
    net = network()
    maps = np.zeros((2, 20, 20), np.uint8)
    maps[0, 9, 10] = maps[0, 3, 3] = 1
    maps[1, 9, 10] = 1
    net.mix = torch.nn.ModuleList()
    with torch.no_grad():
        patches, _ = net.encode(token_batch(pack(maps, 4)))
    # Patches in order: (0, 0) and (2, 2) of the first map, (2, 2) of the second.
    torch.testing.assert_close(patches[1], patches[2], rtol=0, atol=1e-6)
    assert not torch.allclose(patches[0], patches[1])


def test_gradients_reach_every_weight() -> None:
    net = network()
    patches, features = net.encode(token_batch(pack(some_maps(6), 4)))
    (net.command(features).square().sum() + patches.square().sum()).backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name


def test_onnx_runtime_equals_pytorch(exported: Path) -> None:
    net, spec = load_policy(exported)
    assert spec.network == SMALL
    maps = np.concatenate([some_maps(101), np.zeros((2, 20, 20), np.uint8), np.ones((2, 20, 20), np.uint8)])
    packed = pack(maps, 4)
    with torch.no_grad():
        expected = net(token_batch(packed)).numpy()
    np.testing.assert_allclose(PolicyRuntime(exported).commands(packed), expected, atol=1e-4)


def test_what_a_map_gets_does_not_depend_on_its_batch(exported: Path) -> None:
    maps = some_maps(60)
    runtime = PolicyRuntime(exported)
    together = runtime.commands(pack(maps, 4))
    for size in (1, 2, 3, 17):
        apart = [runtime.commands(pack(maps[k : k + size], 4)) for k in range(0, len(maps), size)]
        np.testing.assert_array_equal(np.concatenate(apart), together)


def test_eight_bits_give_nearly_the_same_commands(exported: Path, tmp_path: Path) -> None:
    assert export_policy(exported, some_maps(40), "int8", tmp_path / "eight").mean < 2e-2
    packed = pack(some_maps(20), 4)
    full, eight = PolicyRuntime(exported).commands(packed), PolicyRuntime(tmp_path / "eight").commands(packed)
    assert 0 < np.abs(full - eight).mean() < 2e-2


def test_other_kinds_of_network_are_refused(exported: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="a graph network is needed"):
        GnnRuntime(exported)
    with pytest.raises(ConfigurationError, match="not packed for the network"):
        PolicyRuntime(exported).commands(pack(some_maps(2), 5))
    folder = tmp_path / "foreign"
    folder.mkdir()
    for file in exported.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    described = json.loads((exported / "model.json").read_text()) | {"version": 1}
    del described["sha256"]

    def describe(**changes: object) -> None:
        (folder / "model.json").write_text(json.dumps({**described, "network": {**described["network"], **changes}}))

    describe(kind="mlp")
    with pytest.raises(TriformError, match="no network of kind 'mlp'; there are vit, cnn, gnn"):
        read_spec(folder)
    describe(kind="vit")
    with pytest.raises(TriformError, match="not a readable policy description"):
        read_spec(folder)
    describe(outputs=3)
    with pytest.raises(TriformError, match="gives 4 numbers; its description says 20 and 3"):
        PolicyRuntime(folder)


@pytest.mark.parametrize(
    ("change", "says"),
    [({"patch": 6}, "divide"), ({"patch": 5}, "even"), ({"channels": 0}, "channels"), ({"map_size": 40}, "maps of")],
)
def test_impossible_shapes_are_refused(change: dict, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        replace(SPEC, network=replace(SMALL, **change))
