"""Loaded policies are copied and pickled with what they run on, and no path is needed where they arrive."""

from __future__ import annotations

import copy
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from triform.control import GnnController, LearnedPolicy, make_controller, shipped_weights
from triform.policy import GnnRuntime, PolicyRuntime
from triform.simulation import make_world
from triform.types import Controller, FloatArray, TriformError

WAYS = {"pickle": lambda controller: pickle.loads(pickle.dumps(controller)), "deepcopy": copy.deepcopy}


def load(name: str, folder: Path) -> Controller:
    return GnnController(GnnRuntime(folder)) if name == "gnn" else LearnedPolicy(PolicyRuntime(folder))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", ["default", "cnn", "gnn"])
def test_a_policy_outlives_its_files(name: str, way: str, tmp_path: Path) -> None:
    folder = tmp_path / name
    shutil.copytree(shipped_weights()[name], folder)
    controller = load(name, folder)
    view = make_world(robots=4, runs=2).observe()
    wanted = controller.command(view)
    for file in folder.iterdir():
        file.write_bytes(b"another policy")
    shutil.rmtree(folder)
    other = WAYS[way](controller)
    np.testing.assert_array_equal(other.command(view), wanted)
    assert other.description == controller.description
    assert other.description["weights"] == name


def test_a_policy_does_not_carry_the_path_of_its_files(tmp_path: Path) -> None:
    folder = tmp_path / "default"
    shutil.copytree(shipped_weights()["default"], folder)
    assert str(tmp_path).encode() not in pickle.dumps(LearnedPolicy(PolicyRuntime(folder)))


SOLVE = """
import pickle, sys
controller, view = pickle.loads(sys.stdin.buffer.read())
sys.stdout.buffer.write(pickle.dumps((controller.command(view), controller.description)))
"""


def elsewhere(controller: Controller, view: object, folder: Path) -> tuple[FloatArray, dict[str, object]]:
    """What a controller says in another process that works in another folder."""
    given = pickle.dumps((controller, view))
    done = subprocess.run([sys.executable, "-c", SOLVE], input=given, capture_output=True, check=True, cwd=folder)
    return pickle.loads(done.stdout)


@pytest.mark.parametrize("name", ["policy:default", "gnn"])
def test_a_policy_says_the_same_in_another_process(name: str, tmp_path: Path) -> None:
    controller, view = make_controller(name, threads=2), make_world(robots=4).observe()
    commands, description = elsewhere(controller, view, tmp_path)
    np.testing.assert_array_equal(commands, controller.command(view))
    assert description == controller.description


def test_a_damaged_graph_is_refused_before_it_is_loaded(tmp_path: Path) -> None:
    folder = tmp_path / "default"
    shutil.copytree(shipped_weights()["default"], folder)
    (folder / "model.onnx").write_bytes(b"\0")
    with pytest.raises(TriformError, match="is damaged or belongs to another policy"):
        PolicyRuntime(folder)
