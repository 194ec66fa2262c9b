"""The front door: nineteen names that load when asked for, without extras, and leave the process as it was."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest

import triform
from triform.simulation import get_arena, sample_starts
from triform.types import ConfigurationError

NAMES = {
    "Scan", "ScanConfig", "View", "PrivilegedView", "Controller", "Team", "TriformError", "make_controller",
    "SafetyFilter", "drive", "World", "make_world", "Profile", "Arena", "Scenario", "rollout", "measure", "summarise",
    "evaluate",
}  # fmt: skip


def run(code: str, *options: str) -> str:
    return subprocess.run([sys.executable, *options, "-c", code], capture_output=True, text=True, check=True).stdout


def test_the_names_are_these() -> None:
    assert set(triform.__all__) - {"__version__"} == NAMES
    assert set(dir(triform)) >= NAMES
    assert len(triform.__all__) == len(set(triform.__all__))


def test_importing_leaves_the_environment_and_loads_next_to_nothing() -> None:
    code = """
import os, sys
before, loaded = dict(os.environ), set(sys.modules)
import triform
assert dict(os.environ) == before
new = {name.split(".")[0] for name in set(sys.modules) - loaded}
assert new <= set(sys.stdlib_module_names) | {"triform"}, new
"""
    assert run(code) == ""


def test_no_name_needs_an_extra() -> None:
    code = f"""
import sys
extras = {{
    "pyarrow", "matplotlib", "PIL", "torch", "safetensors", "tensorboard", "onnx", "pyrvo", "ray", "serial", "scipy",
}}
class Without:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in extras:
            raise ModuleNotFoundError(f"{{name}} is an extra", name=name)
sys.meta_path.insert(0, Without())
import triform
for name in {sorted(NAMES)}:
    assert getattr(triform, name).__name__ == name
"""
    assert run(code) == ""


def test_a_star_gives_all_and_a_wrong_name_says_so() -> None:
    names: dict[str, object] = {}
    exec("from triform import *", names)
    assert set(names) >= NAMES
    with pytest.raises(AttributeError, match="module 'triform' has no attribute 'magic'"):
        _ = triform.magic
    with pytest.raises(ImportError, match="cannot import name 'magic'"):
        exec("from triform import magic")


def test_the_package_is_a_program() -> None:
    shown = subprocess.run([sys.executable, "-m", "triform", "--version"], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == triform.__version__
    assert run("import triform.__main__") == ""


@pytest.mark.parametrize(("profile", "arena", "distance"), [("ideal", "open", 1.0), ("hardware", "room-6", 0.7)])
def test_worlds_are_the_first_runs_of_an_evaluation(profile: str, arena: str, distance: float) -> None:
    world = triform.make_world(robots=4, seed=11, runs=3, profile=profile, arena=arena, distance=distance)
    scenario = triform.Scenario(profile=profile, arena=arena, distance=distance, duration=5.0)
    starts = sample_starts(4, 3, 11, distance=distance)
    np.testing.assert_array_equal(world.poses[..., :2], starts[..., :2])
    assert (world.profile, world.arena) == (scenario.robot, get_arena(arena))
    wanted, _ = scenario.run(starts, "triangulating", seed=11)
    found = triform.rollout(world, scenario.make_controller("triangulating"), 5.0)
    np.testing.assert_array_equal(found.poses, wanted.poses)
    np.testing.assert_array_equal(found.commands, wanted.commands)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: triform.make_world(robots=0), "0 robots asked for; at least 1 is needed"),
        (lambda: triform.make_world(runs=0), "runs is 0; at least 1 is needed"),
        (lambda: triform.make_world(seed=-1), "seed -1"),
        (lambda: triform.make_world(distance=0.0), "distance is 0.0 m"),
        (lambda: triform.make_world(profile="idael"), r"no profile 'idael' \(did you mean 'ideal'\?\)"),
        (lambda: triform.make_world(arena="pilars"), r"no arena 'pilars' \(did you mean 'pillars'\?\)"),
        (lambda: triform.make_world(arena="none.toml"), "none.toml cannot be read: no such file"),
    ],
)
def test_a_world_that_cannot_be_is_refused(make: Callable[[], object], says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        make()
