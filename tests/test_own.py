"""The page on own controllers, robots and arenas, followed to the letter; every command line of the docs, parsed."""

from __future__ import annotations

import copy
import pickle
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tyro
from hypothesis import given, settings
from hypothesis import strategies as st

import triform
from triform.cli import COMMANDS, main
from triform.commands.options import CONFIG, registry
from triform.control import CONTROLLERS, ControllerSpec, make_controller
from triform.simulation import (
    ARENAS,
    FOOTPRINTS,
    PROFILES,
    Drive,
    Footprint,
    LidarConfig,
    NoiseBand,
    Profile,
    get_arena,
    get_profile,
    make_world,
    profile_toml,
)
from triform.types import ConfigurationError, PrivilegedView, ScanConfig, TriformError, View

ROOT = Path(__file__).parent.parent
OWN = (ROOT / "docs" / "own.md").read_text()
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "src").glob("triform/weights/*/*.md")),
]


def block(language, holding):
    found = re.findall(rf"```{language}\n(.*?)```", OWN, re.DOTALL)
    return next(each for each in found if holding in each)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(block("python", "class Springs"))
    Path("robot.toml").write_text(block("toml", 'name = "mine"'))
    Path("hall.toml").write_text(block("toml", 'name = "hall"'))
    return tmp_path


def test_the_page_works_as_it_stands(folder, capsys):
    lines = re.findall(r"^    triform evaluate (.*)$", OWN, re.MULTILINE)
    assert len(lines) >= 3
    for line in lines:
        words = shlex.split(line)
        words[words.index("--runs") + 1] = "2"
        assert main(["evaluate", *words, "--duration", "6"]) == 0, line
    assert "mine.py:Springs" in capsys.readouterr().out


def documented():
    for page in PAGES:
        for line in re.findall(r"^    (triform [a-z]+.*)$|`(triform [a-z]+ [^`]*)`", page.read_text(), re.MULTILINE):
            text = (line[0] or line[1]).split(" #")[0].split(" > ")[0].strip()
            if "COMMAND" not in text and not re.search(r"\.\.\.|…|\||[A-Z]{4,}", text):
                yield pytest.param(text, id=f"{page.name}: {text}"[:100])


@pytest.mark.parametrize("text", list(documented()))
def test_every_command_line_of_the_docs_parses(text, folder):
    words = shlex.split(text)
    if words[1] == "COMMAND" or len(words) == 2:
        assert words[1] in COMMANDS or words[1].startswith("-")
        return
    tyro.cli(COMMANDS[words[1]].load(), args=words[2:], config=CONFIG, registry=registry)


def test_the_readme_runs_as_it_stands():
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL).group(1)
    code = "import os\nbefore = dict(os.environ)\n" + code + "\nassert dict(os.environ) == before\n"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "'strict': 1.0" in shown


def test_missing_metadata_of_the_package_stops_nothing(tmp_path):
    (tmp_path / "triform").symlink_to(ROOT / "src" / "triform")
    code = "import sys; sys.path.insert(0, sys.argv[1]); import triform; print(triform.__version__)"
    command = [sys.executable, "-I", "-S", "-c", code, str(tmp_path)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "0+unknown\n"


@pytest.mark.parametrize("name", [*CONTROLLERS, "mine.py:Springs"])
def test_controllers_travel_and_command_the_same(name, folder):
    controller = triform.Scenario().make_controller(name)
    view = make_world(robots=5, runs=2).observe()
    wanted = controller.command(view)
    for other in (pickle.loads(pickle.dumps(controller)), copy.deepcopy(controller)):
        np.testing.assert_array_equal(other.command(view), wanted)
        assert other.description == controller.description
        again = pickle.loads(pickle.dumps(other))
        np.testing.assert_array_equal(again.command(view), wanted)


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("class Mine:\n    pass", r"'bad.py:Mine' has no method command"),
        ("class Other:\n    pass", r"bad.py has no class 'Mine'; its classes are Other"),
        ("import nothing_at_all", r"bad.py cannot be imported: ModuleNotFoundError"),
        (
            "class Mine:\n    def __init__(self): raise ValueError('no')\n    def command(self, view): ...",
            "cannot be made: V",
        ),
        ("class Mine:\n    def command(self, view): return view.poses", "failed: AttributeError"),
        ("class Mine:\n    def command(self, view): return 1", r"of shape \(\); body twists, numbers of shape"),
        (
            "class Mine:\n    def command(self, view): return [[[float('nan')] * 3] * 3]",
            "robot 0 of world 0; a body twist is finite",
        ),
    ],
)
def test_a_controller_that_does_not_work_is_refused_in_a_sentence(code, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("bad.py").write_text(code + "\n")
    view = make_world(robots=3).observe()
    plain = View(view.scans, view.active, view.time)
    with pytest.raises(TriformError, match=f"^[^\n]*{says}[^\n]*$"):
        make_controller("bad.py:Mine").command(plain)


def test_a_privileged_controller_of_a_user_gets_poses_and_asks_for_them(tmp_path):
    code = (
        "import numpy as np\nclass Mine:\n    privileged = True\n    def __init__(self, distance): self.d = distance\n"
    )
    code += "    def command(self, view): return np.where(np.isfinite(view.poses), self.d, 0.0)\n"
    (tmp_path / "mine.py").write_text(code)
    controller = make_controller(f"{tmp_path}/mine.py:Mine", distance=0.7)
    view = make_world(robots=3).observe()
    assert isinstance(view, PrivilegedView)
    assert (controller.command(view) == 0.7).all()
    with pytest.raises(TriformError, match="needs true poses"):
        controller.command(View(view.scans, view.active, view.time))


def test_an_entry_point_is_a_controller(tmp_path, monkeypatch):
    (tmp_path / "brought.py").write_text(block("python", "class Springs"))
    info = tmp_path / "brought-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: brought\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[triform.controllers]\nsix-springs = brought:Springs\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert make_controller("six-springs").description["name"] == "six-springs"
    assert ControllerSpec.parse("brought:Springs").label == "brought:Springs"


SIZES = st.floats(0.05, 2.0)
OUTLINES = st.one_of(
    st.sampled_from(list(FOOTPRINTS.values())),
    st.builds(Footprint.circle, SIZES),
    st.builds(Footprint.box, SIZES, SIZES),
)
LIMITS = st.one_of(st.just(np.inf), st.floats(0.01, 10.0))
PROFILE = st.builds(
    Profile,
    st.text(st.characters(categories=["L", "N"]), min_size=1),
    st.one_of(
        st.builds(Footprint.circle, SIZES),
        st.builds(Footprint.box, SIZES, SIZES),
        st.sampled_from(list(FOOTPRINTS.values())),
    ),
    st.builds(
        LidarConfig,
        st.builds(ScanConfig, st.integers(1, 2000), st.floats(-7, 7), st.floats(0, 0.3), st.floats(0.5, 30)),
        st.lists(st.floats(0.1, 5), unique=True, max_size=3).map(
            lambda ends: tuple(NoiseBand(end, 0.003, 0.01) for end in [*sorted(ends), np.inf])
        ),
        st.floats(0, 0.1),
        st.floats(0, 1),
        st.booleans(),
        st.floats(0.01, 1),
    ),
    st.builds(Drive, LIMITS, LIMITS, LIMITS, LIMITS, LIMITS, st.floats(0, 1)),
    st.floats(0.01, 1),
    st.floats(0, 1),
    st.floats(0.001, 0.1),
    st.booleans(),
)


@settings(deadline=None, max_examples=60)
@given(PROFILE)
def test_a_profile_is_read_as_it_was_written(tmp_path_factory, profile):
    path = tmp_path_factory.mktemp("profile") / "robot.toml"
    path.write_text(profile_toml(profile), encoding="utf-8")
    assert get_profile(str(path)) == profile


@pytest.mark.parametrize("name", [*PROFILES, *ARENAS])
def test_what_show_prints_is_a_file_to_start_from(name, tmp_path, capsys):
    kind = "profile" if name in PROFILES else "arena"
    assert main(["show", kind, name]) == 0
    path = tmp_path / "mine.toml"
    path.write_text(capsys.readouterr().out)
    if kind == "profile":
        assert get_profile(str(path)) == PROFILES[name]
    else:
        found = get_arena(str(path))
        np.testing.assert_array_equal(found.walls, ARENAS[name].walls)
        np.testing.assert_array_equal(found.pillars, ARENAS[name].pillars)
        assert found.name == name


@pytest.mark.parametrize(
    ("kind", "text", "says"),
    [
        ("profile", "footprnt = 'ep'", r"there is no key 'footprnt' \(did you mean 'footprint'\?\); allowed are name"),
        ("profile", "footprint = 'moon'", "mine.toml: footprint is 'moon'"),
        ("profile", "latency = 'long'", "mine.toml: latency is 'long'; a number is needed"),
        ("profile", "latency = -1", "mine.toml: latency is -1.0 s"),
        ("profile", "lidar = 3", "mine.toml: lidar is 3; a table is needed"),
        ("profile", "[lidar]\nrays = 1.5", "mine.toml: lidar.rays is 1.5; a whole number is needed"),
        ("profile", "[lidar]\nperiod = 0", "mine.toml, table lidar: LiDAR period is 0.0 s"),
        ("profile", "[lidar]\nnoise = [{ upto = 1 }]", r"no key 'lidar.noise\[0\].upto' \(did you mean 'up_to'"),
        ("profile", "[drive]\nmax_speed = true", "mine.toml: drive.max_speed is True; a number is needed"),
        ("profile", "[drive]\nlag = inf", "mine.toml, table drive: lag is inf s"),
        ("profile", "= 3", "mine.toml is no TOML file"),
        ("arena", "walls = [[0, 0, 1]]", r"walls is \[0, 0, 1\]; rows of 4 numbers are needed"),
        ("arena", "walls = [[0, 0, 0, 0]]", "mine.toml: a wall has no length"),
        ("arena", "circles = 3", "circles is 3; rows of 3 numbers are needed"),
        ("arena", "boxes = [{ center = [0], length = 1, width = 1 }]", r"boxes\[0\].center is \[0\]; two numbers"),
        ("arena", "boxes = [{ center = [0, 0], width = 1 }]", r"boxes\[0\].length is 0.0; it must be positive"),
    ],
)
def test_a_bad_file_is_refused_with_file_key_and_what_is_allowed(kind, text, says, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=f"^[^\n]*{says}[^\n]*"):
        {"profile": get_profile, "arena": get_arena}[kind](str(path))
    with pytest.raises(ConfigurationError, match=r"none\.toml cannot be read: no such file"):
        {"profile": get_profile, "arena": get_arena}[kind]("none.toml")


@given(
    st.sampled_from(list(FOOTPRINTS.values()))
    | st.builds(Footprint.circle, SIZES)
    | st.builds(Footprint.box, SIZES, SIZES)
)
def test_a_footprint_is_read_as_it_is_spelled(footprint):
    assert Footprint.parse(footprint.label) == footprint
