from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from triform.simulation import HARDWARE, Footprint, LidarConfig, NoiseBand, Profile
from triform.training import PRESETS
from triform.types import ConfigurationError, ScanConfig


def test_presets_know_their_names() -> None:
    assert {name: preset.preset for name, preset in PRESETS.items()} == {name: name for name in PRESETS}


def test_the_robots_of_a_profile_are_what_scenes_show() -> None:
    lidar = LidarConfig(
        ScanConfig(rays=360), (NoiseBand(1.0, absolute=0.01), NoiseBand(math.inf, 0.02, 0.05)), dropout=0.4
    )
    config = PRESETS["quick"].for_robot(Profile("mine", Footprint.circle(0.3), lidar))
    scenes = config.scenes
    assert scenes is not None
    assert scenes.footprint == Footprint.circle(0.3)
    # The farthest that a policy looks is 2 d* of 1.5 m.
    assert scenes.noise == pytest.approx(0.02 + 0.05 * 3.0)
    assert scenes.dropout == 0.4
    assert config.scan == replace(PRESETS["quick"].scan, rays=360)
    # Every scan has its rays, not those of other LiDARs.
    assert scenes.rays == ()
    assert json.loads(json.dumps(config.record()))["scenes"]["footprint"]["shape"] == "circle"


def test_a_robot_with_smaller_errors_leaves_those_of_the_scenes() -> None:
    scenes = PRESETS["default"].for_robot(HARDWARE).scenes
    assert scenes is not None
    assert scenes == replace(PRESETS["default"].scenes, rays=())


def test_a_preset_without_scenes_cannot_be_trained_for_a_robot() -> None:
    with pytest.raises(ConfigurationError, match="'springs' draws no scenes"):
        PRESETS["springs"].for_robot(HARDWARE)
