"""Controllers of a user's own: found, made, checked, copied and pickled, or refused in one sentence."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from triform.control import CONTROLLERS, ControllerSpec, SafetyFilter, ScanPipeline, make_controller
from triform.simulation import make_world
from triform.types import ConfigurationError, PrivilegedView, TriformError, View

COUNTS = """
import numpy as np

class Settings:
    def __init__(self, gain):
        self.gain = gain

class Mine:
    def __init__(self, distance):
        self.settings = Settings(distance)
        self.calls = 0

    def command(self, view):
        self.calls += 1
        return np.full((*view.active.shape, 3), self.settings.gain * self.calls)
"""


@pytest.fixture(scope="module")
def seen() -> PrivilegedView:
    return make_world(robots=3).observe()


def write(folder: Path, code: str, name: str = "mine.py") -> str:
    (folder / name).write_text(code)
    return f"{folder / name}:Mine"


def returning(folder: Path, expression: str, **options: Any) -> Any:
    code = f"import numpy as np\nclass Mine:\n    def command(self, view):\n        return {expression}\n"
    return make_controller(write(folder, code), **options)


def test_a_second_load_of_a_file_gives_the_same_class_until_it_changes(tmp_path: Path) -> None:
    name = write(tmp_path, COUNTS)
    first, second = (make_controller(name)._own for _ in range(2))  # type: ignore[attr-defined]
    assert type(first) is type(second)
    write(tmp_path, COUNTS + "\n# changed\n")
    assert type(make_controller(name)._own) is not type(first)  # type: ignore[attr-defined]


def test_no_compiled_file_is_left_beside_the_users(tmp_path: Path) -> None:
    make_controller(write(tmp_path, COUNTS))
    assert [each.name for each in tmp_path.iterdir()] == ["mine.py"]


@pytest.mark.parametrize("name", ["mine.py", "my springs-v2.1.py", "äöü.py"])
@pytest.mark.parametrize("filtered", [False, True])
def test_a_controller_travels_with_what_it_has_learnt(
    name: str, filtered: bool, tmp_path: Path, seen: PrivilegedView
) -> None:
    controller = make_controller(write(tmp_path, COUNTS, name), distance=0.01)
    if filtered:
        controller = SafetyFilter(controller)
    controller.command(seen)
    others = [copy.deepcopy(controller), pickle.loads(pickle.dumps(controller))]
    (tmp_path / name).unlink()
    others.append(pickle.loads(pickle.dumps(controller)))
    wanted = controller.command(seen)
    assert wanted.any()
    for other in others:
        np.testing.assert_array_equal(other.command(seen), wanted)
        assert other.description == controller.description


def test_a_controller_arrives_in_a_process_that_does_not_have_its_file(tmp_path: Path, seen: PrivilegedView) -> None:
    controller = make_controller(write(tmp_path, COUNTS), distance=0.25)
    controller.command(seen)
    packed = pickle.dumps((controller, seen))
    (tmp_path / "mine.py").unlink()
    code = (
        "import pickle, sys; mine, seen = pickle.loads(sys.stdin.buffer.read()); again = pickle.loads("
        "pickle.dumps(mine)); sys.stdout.buffer.write(pickle.dumps((mine.command(seen), again.command(seen))))"
    )
    done = subprocess.run([sys.executable, "-c", code], input=packed, capture_output=True, check=True)
    wanted = controller.command(seen)
    for commands in pickle.loads(done.stdout):
        np.testing.assert_array_equal(commands, wanted)


def test_poses_are_kept_from_who_does_not_ask_for_them(tmp_path: Path, seen: PrivilegedView) -> None:
    with pytest.raises(TriformError, match="failed: AttributeError: 'View' object has no attribute 'poses'"):
        returning(tmp_path, "view.poses").command(seen)
    rest = returning(tmp_path, "0 * view.odometry + view.noise[..., :1] + view.time").command(seen)
    np.testing.assert_array_equal(rest, np.repeat(seen.noise[..., :1], 3, axis=-1))  # type: ignore[index]


def test_commands_are_numbers_of_their_own(tmp_path: Path, seen: PrivilegedView) -> None:
    for kind in ("np.float32", "np.int8", "np.longdouble"):
        commands = returning(tmp_path, f"np.ones((1, 3, 3), {kind})").command(seen)
        assert commands.dtype == np.float64
        assert (commands == 1.0).all()
    partly = View(seen.scans, np.array([[True, False, True]]), 0.0)
    commands = returning(tmp_path, "np.where(view.active[..., None], 1.0, np.nan) * np.ones(3)").command(partly)
    np.testing.assert_array_equal(commands[0], [[1.0] * 3, [0.0] * 3, [1.0] * 3])


@pytest.mark.parametrize(
    ("expression", "says"),
    [
        ("None", r"an array of object of shape \(\); body twists, numbers of shape \(1, 3, 3\), are needed"),
        ("np.zeros((1, 3, 2))", r"an array of float64 of shape \(1, 3, 2\)"),
        ("np.full((1, 3, 3), '1')", "an array of <U1"),
        ("np.ones((1, 3, 3), complex)", "an array of complex128"),
        ("np.ones((1, 3, 3), bool)", "an array of bool"),
        ("[[[0.0] * 3, [0.0] * 3, [float('inf')] * 3]]", r"\[inf, inf, inf\] for robot 2 of world 0"),
        ("[[1.0], [1.0, 2.0]]", "failed: ValueError: setting an array element"),
        ("1 / 0", "failed: ZeroDivisionError: division by zero"),
    ],
)
def test_what_is_no_command_is_refused(expression: str, says: str, tmp_path: Path, seen: PrivilegedView) -> None:
    with pytest.raises(TriformError, match=rf"^the controller '[^\n]*mine.py:Mine' [^\n]*{says}[^\n]*$"):
        returning(tmp_path, expression).command(seen)


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("import sys; sys.exit(3)", "mine.py cannot be imported: SystemExit: 3"),
        ("class Mine(:", r"mine.py cannot be imported: SyntaxError: invalid syntax"),
        ("class Mime:\n    pass", r"has no class 'Mine' \(did you mean 'Mime'\?\); its classes are Mime"),
        ("Mine = 3", "has no class 'Mine'; its classes are none"),
        ("class Mine:\n    def command(self, view): ...\n    def description(self): ...", "is no dict of plain JSON"),
        ("class Mine:\n    command = print\n    description = {'a': {1, 2}}", "is no dict of plain JSON"),
        (
            "class Mine:\n    command = print\n    def __init__(self, gain): ...",
            "cannot be made: TypeError: [^\n]*gain",
        ),
    ],
)
def test_a_class_that_cannot_be_used_is_refused(code: str, says: str, tmp_path: Path) -> None:
    for _ in range(2):
        with pytest.raises(ConfigurationError, match=f"^[^\n]*{says}[^\n]*$"):
            make_controller(write(tmp_path, code))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("polcy:paper", r"there is no controller 'polcy' \(did you mean 'policy'\?\); there are policy, expert"),
        ("nothing.at.all:Mine", "there is no controller 'nothing.at.all'; there are policy"),
        ("numpy.nothing:Mine", "numpy.nothing cannot be imported: ModuleNotFoundError"),
        ("numpy:Mine", "numpy has no class 'Mine'"),
        ("none.py:Mine", "the file none.py with a controller cannot be read: no such file"),
        ("mine.py", "'mine.py' names no class; write mine.py:CLASS"),
        ("mine.py:", "'mine.py' names no class; write mine.py:CLASS"),
        (":", "there is no controller ''"),
        ("", "there is no controller ''"),
        ("policy:", "'policy:' names no weights after the colon"),
        ("policy:papr", r"there is no policy 'papr' \(did you mean 'paper'\?\): it is neither a folder nor one of"),
        ("triangulating:paper", "'triangulating' has no weights; they belong to policy and gnn"),
        ("scan-triangulating:", "'scan-triangulating:' names no footprint after the colon"),
        (
            "scan-pipeline:epp",
            r"a footprint or 'unknown', but the footprint is 'epp' \(did you mean 'ep'\?\)",
        ),
        ("scan-pipeline:box:0.4x-1", "a footprint or 'unknown', but the footprint is 0.4 m x -1.0 m"),
    ],
)
def test_a_name_of_no_controller_is_refused(text: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=f"^[^\n]*{says}[^\n]*$"):
        make_controller(text)


def test_weights_are_said_in_one_way() -> None:
    assert ControllerSpec.parse("policy:paper") == ControllerSpec("policy", "paper")
    with pytest.raises(ConfigurationError, match="'policy:paper'; it is 'policy', with the weights 'paper' beside it"):
        ControllerSpec("policy:paper", "default")


def test_a_footprint_is_said_in_one_way() -> None:
    spec = ControllerSpec.parse("scan-triangulating:circle:0.30")
    assert spec == ControllerSpec("scan-triangulating", footprint="circle:0.30") == spec.resolved
    with pytest.raises(ConfigurationError, match="it is 'scan-pipeline', with the footprint 'ep' beside it"):
        ControllerSpec("scan-pipeline:ep")
    with pytest.raises(ConfigurationError, match="'policy' takes no footprint; scan-pipeline and"):
        ControllerSpec("policy", footprint="ep")


def test_a_footprint_that_a_controller_names_comes_before_that_of_the_robots() -> None:
    def fitted(text: str) -> object:
        return make_controller(text, footprint=0.2).description["footprint"]

    assert fitted("scan-pipeline") == fitted("scan-pipeline:circle-10")
    assert fitted("scan-pipeline:ep") == ScanPipeline().description["footprint"]
    assert fitted("scan-pipeline:unknown") == "unknown" == ScanPipeline(footprint=None).description["footprint"]


SPELLED = (
    "policy:paper", "gnn:a/b:c", "mine.py:Mine", "a:b.py:C_1", "scan-pipeline:unknown",
    "scan-triangulating:box:0.41x0.24",
)  # fmt: skip


@given(st.sampled_from(CONTROLLERS) | st.sampled_from(SPELLED))
def test_a_label_is_read_as_it_was_written(text: str) -> None:
    spec = ControllerSpec.parse(text)
    assert spec.label == text
    assert pickle.loads(pickle.dumps(spec)) == spec


@given(st.text())
def test_any_text_names_a_controller_or_is_refused(text: str) -> None:
    try:
        label, said = ControllerSpec.parse(text).label, ""
    except ConfigurationError as error:
        label, said = text, str(error)
    assert (label, "\n" in said) == (text, False)
