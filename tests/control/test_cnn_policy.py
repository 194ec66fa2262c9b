from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from triform.control import make_controller
from triform.perception import occupancy_maps
from triform.policy import CnnConfig, PolicyRuntime, PolicySpec, pack
from triform.policy.cnn import ConvolutionalNetwork
from triform.policy.export import export_policy
from triform.policy.weights import save_policy
from triform.simulation import World, get_profile, sample_starts
from triform.threads import limit_threads
from triform.types import MapConfig, ScanConfig, View


def test_a_convolutional_network_drives_robots_from_their_scans_alone(tmp_path: Path) -> None:
    config = CnnConfig(stem=4, channels=8, depth=1, squeeze=4, dim=16, mlp=16)
    spec = PolicySpec(config, ScanConfig(), MapConfig())
    torch.manual_seed(0)
    save_policy(tmp_path, ConvolutionalNetwork(config), spec)
    view = World(sample_starts(7, 20, seed=2), get_profile("ideal")).observe()
    blind = View(view.scans, view.active, 0.0)
    maps = occupancy_maps(view.scans, MapConfig()).reshape(-1, 100, 100)
    export_policy(tmp_path, maps[:20])
    controller = make_controller(f"policy:{tmp_path}")
    assert not controller.privileged
    assert controller.description["network"]["kind"] == "cnn"
    answers = PolicyRuntime(tmp_path).commands(pack(maps, config.patch))
    with limit_threads(1):
        alone = controller.command(blind)
    np.testing.assert_array_equal(alone.reshape(-1, 3), answers[:, :3])
    with limit_threads(3):
        np.testing.assert_array_equal(controller.command(blind), alone)
