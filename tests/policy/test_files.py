from __future__ import annotations

import json
import struct
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from triform.decode import checksum
from triform.files import sha256
from triform.policy import NetworkConfig, PackedMaps, PolicyRuntime, PolicySpec, pack, read_spec
from triform.policy.checkpoint import graph_path, read_weights, weights_name, weights_path, write_policy
from triform.policy.export import export_policy
from triform.policy.vit import VisionTransformer, token_batch
from triform.policy.weights import load_policy, save_policy
from triform.types import ConfigurationError, MapConfig, ScanConfig, TriformError

SPEC = PolicySpec(
    NetworkConfig(map_size=20, patch=5, dim=16, depth=2, heads=4, mlp=24),
    ScanConfig(),
    MapConfig(size=20, cell=0.2, max_cells=50),
    training={"seed": 3},
)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policy") / "small"
    torch.manual_seed(0)
    network = VisionTransformer(SPEC.network)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    save_policy(folder, network, SPEC)
    assert export_policy(folder, some_maps(50)).largest <= 1e-4
    return folder


def weights_file(folder: Path) -> Path:
    return weights_path(folder, read_spec(folder))


def graph_file(folder: Path) -> Path:
    return graph_path(folder, read_spec(folder))


def describe(folder: Path, **changes: object) -> None:
    """Describe the policy in ``folder`` otherwise, as earlier versions did, without a checksum."""
    described = json.loads((folder / "model.json").read_text()) | {"version": 1} | changes
    described.pop("sha256", None)
    (folder / "model.json").write_text(json.dumps(described))


def copy(folder: Path, to: Path) -> Path:
    to.mkdir()
    for file in folder.iterdir():
        (to / file.name).write_bytes(file.read_bytes())
    return to


def some_maps(count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    return (rng.random((count, 20, 20)) < rng.uniform(0, 0.1, (count, 1, 1))).astype(np.uint8)


def test_a_policy_comes_back_as_it_was_saved(exported: Path) -> None:
    network, spec = load_policy(exported)
    assert spec == replace(SPEC, weights_sha256=spec.weights_sha256, onnx_sha256=spec.onnx_sha256)
    assert len(spec.weights_sha256) == 64
    torch.manual_seed(0)
    fresh = VisionTransformer(SPEC.network)
    assert [tuple(p.shape) for p in network.parameters()] == [tuple(p.shape) for p in fresh.parameters()]


def test_onnx_runtime_equals_pytorch_for_any_number_of_patches(exported: Path) -> None:
    network, _ = load_policy(exported)
    maps = np.concatenate([some_maps(600), np.zeros((2, 20, 20), np.uint8), np.ones((2, 20, 20), np.uint8)])
    packed = pack(maps, 5)
    with torch.no_grad():
        expected = network(token_batch(packed)).numpy()
    commands = PolicyRuntime(exported).commands(packed)
    assert commands.shape == (604, 3)
    np.testing.assert_allclose(commands, expected, atol=1e-4)


def test_what_a_map_gets_does_not_depend_on_its_batch(exported: Path) -> None:
    maps = some_maps(300)
    runtime = PolicyRuntime(exported)
    together = runtime.commands(pack(maps, 5))
    for size in (1, 2, 3, 50):
        apart = [runtime.commands(pack(maps[k : k + size], 5)) for k in range(0, len(maps), size)]
        np.testing.assert_array_equal(np.concatenate(apart), together)


def test_threads_share_a_policy(exported: Path) -> None:
    runtime = PolicyRuntime(exported)
    packed = [pack(some_maps(40 + k), 5) for k in range(20)]
    expected = [runtime.commands(each) for each in packed]
    with ThreadPoolExecutor(4) as pool:
        for found, wanted in zip(pool.map(runtime.commands, packed), expected, strict=True):
            np.testing.assert_array_equal(found, wanted)


def test_a_graph_that_differs_from_pytorch_is_not_kept(
    exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = copy(exported, tmp_path / "policy")
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    monkeypatch.setattr("triform.policy.graph._EPSILON", 0.1)
    with pytest.raises(TriformError, match="differs from PyTorch"):
        export_policy(folder, some_maps(20))
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


@pytest.mark.parametrize("change", [{"depth": 1}, {"attention": "all"}, {"heads": 1}, {"outputs": 7}])
def test_every_shape_of_network_can_be_exported(change: dict, tmp_path: Path) -> None:
    spec = replace(SPEC, network=replace(SPEC.network, **change))
    save_policy(tmp_path / "policy", VisionTransformer(spec.network), spec)
    assert export_policy(tmp_path / "policy", some_maps(20)).largest <= 1e-4


def test_eight_bits_give_nearly_the_same_commands(exported: Path, tmp_path: Path) -> None:
    packed = pack(some_maps(200), 5)
    difference = export_policy(exported, some_maps(100), "int8", tmp_path / "eight")
    assert 1e-4 < difference.mean < 2e-2
    assert read_spec(tmp_path / "eight").precision == "int8"
    assert read_spec(exported).precision == "float32"
    assert weights_file(tmp_path / "eight").read_bytes() == weights_file(exported).read_bytes()
    full, eight = PolicyRuntime(exported).commands(packed), PolicyRuntime(tmp_path / "eight").commands(packed)
    assert 0 < np.abs(full - eight).mean() < 2e-2
    alone = PolicyRuntime(tmp_path / "eight").commands(pack(some_maps(200)[7:8], 5))
    np.testing.assert_array_equal(alone[0], eight[7])
    with pytest.raises(ConfigurationError, match="precision is 'int4'"):
        replace(SPEC, precision="int4")


@pytest.mark.parametrize(
    "change",
    [
        lambda p: pack(some_maps(3), 10),
        lambda p: pack(np.ones((2, 40, 40), np.uint8), 5),
        lambda p: replace(p, counts=p.counts[:-1]),
        lambda p: replace(p, positions=p.positions - 1),
        lambda p: replace(p, positions=p.positions + 15),
        lambda p: replace(p, counts=-p.counts),
    ],
)
def test_maps_packed_for_another_network_are_refused(
    exported: Path, change: Callable[[PackedMaps], PackedMaps]
) -> None:
    with pytest.raises(ConfigurationError, match="not packed for the network"):
        PolicyRuntime(exported).commands(change(pack(np.ones((2, 20, 20), np.uint8), 5)))


def test_an_export_that_cannot_be_written_leaves_the_old_one(
    exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = copy(exported, tmp_path / "policy")
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    real = Path.open

    def full(self: Path, *arguments: object, **options: object) -> object:
        if self.parent == folder and self.name.startswith(".model.json."):
            raise OSError(28, "No space left on device")
        return real(self, *arguments, **options)

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(TriformError, match="no space left"):
        export_policy(folder, some_maps(5), "int8")
    monkeypatch.undo()
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_no_maps_give_no_commands(exported: Path) -> None:
    nothing = PackedMaps(np.empty((0, 25), np.uint8), np.empty(0, np.int64), np.empty(0, np.int64))
    assert PolicyRuntime(exported).commands(nothing).shape == (0, 3)


def test_the_weights_stand_in_one_file_only(exported: Path) -> None:
    weights = weights_file(exported).read_bytes()
    (length,) = struct.unpack_from("<Q", weights)
    graph = graph_file(exported).read_bytes()
    header = json.loads(weights[8 : 8 + length])
    begin, end = header["blocks.0.qkv.weight"]["data_offsets"]
    assert weights[8 + length + begin : 8 + length + end] not in graph
    assert b"site-packages" not in graph
    assert b"/src/" not in graph


def test_a_foreign_or_damaged_folder_is_refused(exported: Path, tmp_path: Path) -> None:
    with pytest.raises(TriformError, match="holds no policy"):
        read_spec(tmp_path)
    broken = copy(exported, tmp_path / "json")
    (broken / "model.json").write_text("{")
    with pytest.raises(TriformError, match=r"model\.json cannot be read"):
        read_spec(broken)
    (broken / "model.json").write_text(json.dumps({"format": "other", "version": 1}))
    with pytest.raises(TriformError, match="does not describe a triform policy"):
        read_spec(broken)
    (broken / "model.json").write_text(SPEC.to_json().replace('"version": 2', '"version": 99'))
    with pytest.raises(TriformError, match="version 99"):
        read_spec(broken)
    network = json.loads((exported / "model.json").read_text())["network"]
    (broken / "model.json").write_bytes((exported / "model.json").read_bytes())
    describe(broken, network={**network, "dim": 32})
    with pytest.raises(TriformError, match="do not fit"):
        load_policy(broken)

    truncated = copy(exported, tmp_path / "weights")
    flipped = bytearray(weights_file(exported).read_bytes())
    flipped[-5] ^= 1
    for damaged in (bytes(flipped[:-100]), bytes(flipped)):
        weights_file(truncated).write_bytes(damaged)
        for load in (load_policy, PolicyRuntime):
            with pytest.raises(TriformError, match="damaged or belongs to another"):
                load(truncated)
    weights_file(truncated).unlink()
    with pytest.raises(TriformError, match="cannot read the weights"):
        load_policy(truncated)

    graph = bytearray(graph_file(exported).read_bytes())
    graph[len(graph) // 2] ^= 1
    flipped_graph = copy(exported, tmp_path / "graph")
    graph_file(flipped_graph).write_bytes(bytes(graph))
    with pytest.raises(TriformError, match=r"graph .* is damaged"):
        PolicyRuntime(flipped_graph)

    foreign = copy(exported, tmp_path / "foreign")
    describe(foreign, network={**network, "patch": 4})
    with pytest.raises(TriformError, match="patches of width 25"):
        PolicyRuntime(foreign)
    describe(foreign, onnx_sha256=sha256(b"nonsense"))
    (foreign / "model.onnx").write_bytes(b"nonsense")
    with pytest.raises(TriformError, match="cannot load the policy"):
        PolicyRuntime(foreign)

    bare = copy(exported, tmp_path / "bare")
    graph_file(bare).unlink()
    with pytest.raises(TriformError, match="triform export"):
        PolicyRuntime(bare)
    with pytest.raises(ConfigurationError, match="threads"):
        PolicyRuntime(exported, threads=0)


def test_a_pickle_is_never_loaded(tmp_path: Path) -> None:
    pickled = tmp_path / "policy.pt"
    torch.save(VisionTransformer(SPEC.network).state_dict(), pickled)
    for load in (load_policy, PolicyRuntime, lambda path: export_policy(path, some_maps(1))):
        with pytest.raises(TriformError, match="pickled checkpoints are never loaded"):
            load(pickled)
    folder = tmp_path / "policy"
    folder.mkdir()
    (folder / "model.safetensors").write_bytes(pickled.read_bytes())
    (folder / "model.json").write_text(replace(SPEC, weights_sha256=sha256(pickled.read_bytes())).to_json())
    with pytest.raises(TriformError, match="do not fit"):
        load_policy(folder)


def test_a_failed_write_leaves_the_old_policy(exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = copy(exported, tmp_path / "policy")

    def full(self: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(TriformError, match="no space left"):
        save_policy(folder, VisionTransformer(SPEC.network), SPEC)
    monkeypatch.undo()
    assert {f.name: f.read_bytes() for f in folder.iterdir()} == {f.name: f.read_bytes() for f in exported.iterdir()}


def test_what_a_policy_uses_of_a_scan_scales_with_the_distance() -> None:
    spec = PolicySpec(NetworkConfig(), ScanConfig(), MapConfig(), distances=(0.6, 1.5))
    lidar = ScanConfig(rays=667, range_min=0.1, range_max=8.0)
    for distance in (0.6, 0.8, 1.0, 1.5):
        scan, made = spec.views(lidar, distance)
        assert spec.scale(distance) == distance
        assert scan == replace(lidar, range_max=2.0 * distance)
        assert made == replace(MapConfig(), cell=0.04 * distance)
    # A policy that was trained at another distance than 1 m has maps for that.
    other = replace(spec, scan=ScanConfig(range_max=1.6), map=MapConfig(cell=0.032), distance=0.8)
    scan, made = other.views(lidar, 1.2)
    assert (other.scale(1.2), scan.range_max, made.cell) == pytest.approx((1.5, 2.4, 0.048))
    one = replace(spec, distances=None)
    assert one.views(ScanConfig(), 1.0) == (ScanConfig(), MapConfig())


def test_scans_that_make_other_maps_are_refused() -> None:
    spec = PolicySpec(NetworkConfig(), ScanConfig(), MapConfig(), distances=(0.5, 2.0))
    with pytest.raises(ConfigurationError, match=r"range of 2 m for a distance of 1 m; this scan has range_max 1\.9 m"):
        spec.views(ScanConfig(range_max=1.9), 1.0)
    with pytest.raises(ConfigurationError, match=r"range of 2\.4 m for a distance of 1\.2 m"):
        spec.views(ScanConfig(), 1.2)
    assert spec.views(ScanConfig(range_max=1.0), 0.5)[0].range_max == 1.0
    with pytest.raises(ConfigurationError, match=r"cells of 0\.04 m; this scan has 90 rays, which lie more"):
        spec.views(ScanConfig(rays=90), 1.0)
    # Rays and cells are angles and lengths: their ratio is the same at every distance.
    for distance in (0.5, 1.0, 2.0):
        lidar = ScanConfig(rays=315, range_max=8.0)
        assert spec.views(lidar, distance)[0].rays == 315
        with pytest.raises(ConfigurationError, match="more than a cell apart"):
            spec.views(replace(lidar, rays=314), distance)


@pytest.mark.parametrize("distance", [0.0, 0.599, 1.501, -1.0, np.inf, np.nan])
def test_distances_that_were_not_trained_are_refused(distance: float) -> None:
    spec = PolicySpec(NetworkConfig(), ScanConfig(), MapConfig(), distances=(0.6, 1.5))
    for refused in (spec.scale, lambda value: spec.views(ScanConfig(range_max=9.0), value)):
        with pytest.raises(ConfigurationError, match=rf"trained for distances of 0\.6 m to 1\.5 m, not {distance} m"):
            refused(distance)
        with pytest.raises(ConfigurationError, match=rf"trained for a distance of 1\.0 m, not {distance} m"):
            replace(spec, distances=None).scale(distance)


def test_distances_rest_and_pushes_come_back(tmp_path: Path) -> None:
    spec = replace(SPEC, distances=(0.6, 1.5), rest_speed=0.02, least_push=0.05)
    assert PolicySpec.from_json(spec.to_json().encode(), "here") == spec
    save_policy(tmp_path / "policy", VisionTransformer(spec.network), spec)
    back = read_spec(tmp_path / "policy")
    assert back == replace(spec, weights_sha256=back.weights_sha256)
    assert isinstance(back.distances, tuple)


def test_descriptions_of_earlier_releases_are_read() -> None:
    data = json.loads(SPEC.to_json()) | {"version": 1}
    del data["sha256"]
    for name in ("distances", "rest_speed", "least_push", "precision"):
        del data[name]
    data["network"].pop("kind", None)
    old = PolicySpec.from_json(json.dumps(data).encode(), "here")
    assert old == SPEC
    assert (old.distances, old.rest_speed, old.least_push) == (None, 0.0, 0.0)
    for strange in ([0.6], [0.6, 1.0, 1.5], "far", 7, [1.5, 0.6], ["a", "b"]):
        with pytest.raises(TriformError, match=r"readable policy|must hold the distance"):
            PolicySpec.from_json(json.dumps({**data, "distances": strange}).encode(), "here")
    with pytest.raises(TriformError, match="not a readable policy"):
        PolicySpec.from_json(json.dumps({**data, "colour": "red"}).encode(), "here")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        *(({"distances": pair}, "must hold the distance 1.0 m") for pair in (
            (0.0, 1.5), (1.1, 1.5), (0.5, 0.9), (1.5, 0.6), (0.6, np.inf), (np.nan, 1.5)
        )),
        *(({name: value}, f"{name} is {value} m/s") for name in ("rest_speed", "least_push") for value in (
            -0.1, np.nan, np.inf
        )),
    ],
)  # fmt: skip
def test_descriptions_that_make_no_sense_are_refused(change: dict, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        replace(SPEC, **change)


def test_a_network_for_other_maps_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="cells"):
        PolicySpec(NetworkConfig(), ScanConfig(), MapConfig(size=50))


def some_policies(tmp_path: Path, count: int) -> list[tuple[PolicySpec, bytes]]:
    """Descriptions and weights of policies that differ in their ``rest_speed``."""
    found = []
    for number in range(count):
        torch.manual_seed(number)
        save_policy(tmp_path / "each", VisionTransformer(SPEC.network), replace(SPEC, rest_speed=0.01 * number))
        found.append(read_weights(tmp_path / "each"))
    return found


def test_a_policy_takes_the_place_of_another_and_of_nothing_else(exported: Path, tmp_path: Path) -> None:
    folder = copy(exported, tmp_path / "policy")
    strangers = {"README.md", "model-mine.safetensors", "model.onnx.txt", "best.onnx"}
    for name in strangers:
        (folder / name).write_bytes(b"not ours")
    ((spec, weights),) = some_policies(tmp_path, 1)
    write_policy(folder, spec, weights)
    assert {f.name for f in folder.iterdir()} == strangers | {"model.json", weights_name(spec)}
    export_policy(folder, some_maps(5))
    assert {f.name for f in folder.iterdir()} == strangers | {"model.json", weights_name(spec), graph_file(folder).name}
    # Shipped policies and old ones have plain names; they are replaced all the same.
    old = tmp_path / "old"
    old.mkdir()
    for name, data in (("model.safetensors", weights), ("model.onnx", b""), ("model.json", spec.to_json().encode())):
        (old / name).write_bytes(data)
    assert read_weights(old) == (spec, weights)
    export_policy(old, some_maps(5))
    assert {f.name for f in old.iterdir()} == {"model.json", weights_name(spec), graph_file(old).name}


def test_an_export_does_not_undo_a_save_that_came_between(exported: Path, tmp_path: Path) -> None:
    folder = copy(exported, tmp_path / "policy")
    before = read_spec(folder)
    ((spec, weights),) = some_policies(tmp_path, 1)
    write_policy(folder, spec, weights)
    with pytest.raises(TriformError, match="another process has replaced the policy"):
        write_policy(folder, before, b"weights", b"graph", instead_of=before)
    assert read_weights(folder) == (spec, weights)


def test_a_policy_is_read_whole_while_others_replace_it(tmp_path: Path) -> None:
    policies = some_policies(tmp_path, 2)
    folder, stop = tmp_path / "policy", threading.Event()
    write_policy(folder, *policies[0])

    def replace_it() -> None:
        while not stop.is_set():
            for each in policies:
                write_policy(folder, *each)

    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(replace_it)
        try:
            assert all(read_weights(folder) in policies for _ in range(200))
        finally:
            stop.set()
        done.result()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"rest_speed": 1e30}, r"rest_speed is 1e\+30 m/s; it must lie in \[0, 10\] m/s"),
        ({"rest_speed": True}, "rest_speed is True; a number is needed"),
        ({"distance": 1e9}, "distances"),
        ({"distance": "1"}, "distance is '1'; a number is needed"),
        (
            {"scan": {"rays": True, "angle_min": 0.0, "range_min": 0.0, "range_max": 2.0}},
            "rays is True; a whole number",
        ),
        ({"scan": {"rays": 450}}, "must hold exactly the values angle_min, range_max, range_min, rays"),
        ({"network": {"dim": 10**9}}, "dim is 1000000000; it must be at least 1 and at most 4096"),
        ({"network": {"attention": "some"}}, "attention is 'some'; it must be occupied or all"),
        ({"network": []}, "it describes no network"),
        ({"weights_sha256": "../../../elsewhere"}, "64 hexadecimal digits"),
        ({"training": 7}, "training is 7; an object is needed"),
    ],
)
def test_values_of_other_types_and_beyond_limits_are_refused(change: dict, says: str, exported: Path) -> None:
    described = json.loads((exported / "model.json").read_text())
    with pytest.raises(TriformError, match="checksum differs"):
        PolicySpec.from_json(json.dumps(described | change).encode(), "here")
    signed = {key: value for key, value in (described | change).items() if key not in ("format", "version", "sha256")}
    for head in ({"version": 1}, {"version": 2, "sha256": checksum(signed)}):
        with pytest.raises(TriformError, match=says):
            PolicySpec.from_json(json.dumps({"format": "triform-policy"} | head | signed).encode(), "here")
