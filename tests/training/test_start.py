"""Training that begins from a policy: it does at first what the policy does, also with a larger map around it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from triform.policy import CnnConfig, NetworkConfig, PolicySpec, pack
from triform.policy.kinds import make_network, network_inputs
from triform.policy.weights import save_policy
from triform.training import PRESETS, train
from triform.training.start import begin_from
from triform.types import ConfigurationError, MapConfig, ScanConfig, TriformError

SMALL = NetworkConfig(map_size=40, dim=16, depth=2, heads=2, mlp=16, outputs=4)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    torch.manual_seed(3)
    network = make_network(SMALL)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    save_policy(tmp_path / "policy", network, PolicySpec(SMALL, ScanConfig(), MapConfig(size=40)))
    return tmp_path / "policy"


@pytest.mark.parametrize("size", [40, 60, 100])
@torch.no_grad()
def test_a_larger_map_answers_alike_to_the_same_surroundings(folder: Path, size: int) -> None:
    rng = np.random.default_rng(size)
    maps = (rng.random((20, 40, 40)) < 0.02).astype(np.uint8)
    margin = (size - 40) // 2
    around = np.pad(maps, ((0, 0), (margin, margin), (margin, margin)))
    same, larger = make_network(SMALL), make_network(replace(SMALL, map_size=size))
    begin_from(folder, same, MapConfig(size=40))
    begin_from(folder, larger, MapConfig(size=size))
    cpu = torch.device("cpu")
    wanted, found = same(network_inputs(pack(maps, 10), cpu)), larger(network_inputs(pack(around, 10), cpu))
    assert wanted.std(0).min() > 1e-3
    torch.testing.assert_close(found, wanted, atol=1e-5, rtol=0)
    if margin:
        # Beyond the old map, a patch begins as the nearest one within it.
        corner, inner = np.zeros((2, 1, size, size), dtype=np.uint8)
        corner[0, 0, 0] = inner[0, margin, margin] = 1
        answers = [larger(network_inputs(pack(each, 10), cpu)) for each in (corner, inner)]
        torch.testing.assert_close(answers[0], answers[1], atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("network", "cell", "says"),
    [
        (replace(SMALL, dim=32), 0.04, "another shape"),
        (replace(SMALL, patch=8), 0.04, "4 x 4 patches"),
        (replace(SMALL, map_size=50), 0.04, "4 x 4 patches"),
        (replace(SMALL, map_size=20), 0.04, "4 x 4 patches"),
        (SMALL, 0.05, "cells of the policy"),
        (CnnConfig(map_size=40), 0.04, "another shape"),
    ],
)
def test_other_shapes_are_refused(folder: Path, network: NetworkConfig, cell: float, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        begin_from(folder, make_network(network), MapConfig(size=network.map_size, cell=cell))


@pytest.mark.parametrize("start", ["paper", "no such policy"])
def test_a_training_that_cannot_begin_leaves_nothing_behind(start: str, tmp_path: Path) -> None:
    with pytest.raises(TriformError):
        train(replace(PRESETS["quick"], maps=112, start=start), tmp_path / "run")
    assert not (tmp_path / "run").exists()
