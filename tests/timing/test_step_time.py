from __future__ import annotations

import time

import numpy as np
import pytest

from triform.control import CONTROLLERS, ControllerSpec, make_controller, shipped_weights
from triform.evaluation.overrides import Overrides
from triform.evaluation.scenario import Scenario
from triform.policy.checkpoint import read_spec, write_policy
from triform.timing.step_time import (
    TEAM,
    count_parameters,
    network_size,
    record_views,
    single_views,
    step_times,
    what_it_sees,
)
from triform.types import TriformError


@pytest.fixture(scope="module")
def views():
    return record_views(Scenario(), 3)


@pytest.mark.parametrize("profile", ["ideal", "hardware"])
def test_views_are_of_one_team_on_its_way(profile):
    seen = record_views(Scenario(profile=profile), 3)
    assert len(seen) == 20
    poses = np.concatenate([view.poses for view in seen])
    assert poses.shape == (20, TEAM, 3)
    assert np.linalg.norm(np.diff(poses[..., :2], axis=0), axis=-1).max() > 0.01
    for view in seen:
        assert np.isfinite(view.scans.ranges).any(axis=-1).all()


def test_a_robot_alone_sees_what_it_sees_in_its_team(views):
    singles = single_views(views)
    assert len(singles) == TEAM * len(views)
    for name in ("policy", "scan-pipeline", "scan-triangulating"):
        controller = make_controller(name)
        together = np.concatenate([controller.command(view).reshape(-1, 3) for view in views[:4]])
        alone = np.concatenate([controller.command(view).reshape(-1, 3) for view in singles[: 4 * TEAM]])
        np.testing.assert_array_equal(alone, together)


def test_a_robot_alone_keeps_its_intensities():
    views = record_views(Scenario(overrides=Overrides(min_intensity=200.0)), 3)
    alone = np.concatenate([view.scans.intensities for view in single_views(views)], axis=1)
    np.testing.assert_array_equal(alone, np.concatenate([view.scans.intensities for view in views], axis=1))


class Sleeper:
    """Takes a known time and remembers the shapes of its views."""

    description = {"name": "sleeper"}  # noqa: RUF012

    def __init__(self, seconds, privileged):
        self.seconds, self.privileged = seconds, privileged
        self.shapes = set()

    def command(self, view):
        self.shapes.add(view.active.shape)
        time.sleep(self.seconds)
        return np.zeros((*view.active.shape, 3))


def test_teams_are_timed_by_robot(views):
    alone, team = Sleeper(0.0005, False), Sleeper(0.0005, True)
    found = step_times({"alone": alone, "team": team}, views)
    assert (alone.shapes, team.shapes) == ({(1, 1)}, {(1, TEAM)})
    # Sleeping takes at least as long as asked.
    assert found["alone"] >= 0.0005
    assert found["team"] >= 0.0005 / TEAM


@pytest.mark.parametrize("name", ["default", "large"])
def test_parameters_are_those_of_the_weights(name):
    safetensors = pytest.importorskip("safetensors.numpy")
    folder = shipped_weights()[name]
    tensors = safetensors.load_file(folder / "model.safetensors")
    assert count_parameters(folder) == sum(tensor.size for tensor in tensors.values())
    assert network_size(ControllerSpec("policy", name)) == count_parameters(folder)
    assert network_size(ControllerSpec("expert")) is None


def test_weights_that_cannot_be_read_are_refused(tmp_path):
    with pytest.raises(TriformError, match="holds no policy"):
        count_parameters(tmp_path)
    spec = read_spec(shipped_weights()["default"])
    deep = 10_000 * b"["
    for content in (b"", b"\x02" + bytes(7) + b"[]", b"\x09" + bytes(7) + b'{"a": {}}', b"\x10\x27" + bytes(6) + deep):
        write_policy(tmp_path, spec, content)
        with pytest.raises(TriformError, match="the weights"):
            count_parameters(tmp_path)


def test_it_is_known_of_every_controller_what_it_sees():
    seen = {text: what_it_sees(ControllerSpec.parse(text)) for text in CONTROLLERS}
    assert all(seen.values())
    for footprint in ("ep", "unknown"):
        assert what_it_sees(ControllerSpec("scan-pipeline", footprint=footprint)) not in seen.values()
