"""Profiles and arenas in files: what is written is read back, and whatever a file holds is refused in one sentence."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from triform.simulation import (
    Arena,
    Drive,
    Footprint,
    LidarConfig,
    NoiseBand,
    Profile,
    arena_toml,
    get_arena,
    get_profile,
    profile_toml,
)
from triform.types import ConfigurationError, ScanConfig

READERS = {"profile": get_profile, "arena": get_arena}
SHARED = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
#: What TOML can spell: surrogates it cannot.
TEXT = st.text(st.characters(exclude_categories=["Cs"]))
COORDINATES = st.floats(-1e6, 1e6)


@SHARED
@given(name=TEXT)
@example(name='a "robot"\\ of\nours\t\x00\x7f 🤖 # = [x]')
def test_any_name_is_read_as_it_was_written(name: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(profile_toml(Profile(name)), encoding="utf-8", newline="")
    assert get_profile(str(path)) == Profile(name)
    path.write_text(arena_toml(Arena(name)), encoding="utf-8", newline="")
    assert get_arena(str(path)).name == name


def test_numbers_of_numpy_and_whole_ones_are_written_as_numbers(tmp_path: Path) -> None:
    number = np.float64
    profile = Profile(
        "mine",
        Footprint.circle(number(0.3)),
        LidarConfig(ScanConfig(360, number(0.5), 0, 3), (NoiseBand(math.inf, number(0.01)),), period=number(0.2)),
        Drive(max_speed=1, lag=number(0.1)),
        control_period=number(0.2),
        latency=0,
    )
    path = tmp_path / "mine.toml"
    path.write_text(profile_toml(profile))
    assert get_profile(str(path)) == profile
    assert Footprint.box(number(0.4), 1).label == "box:0.4x1.0"


@SHARED
@given(
    walls=st.lists(st.tuples(*[COORDINATES] * 4).filter(lambda wall: wall[:2] != wall[2:]), max_size=4),
    circles=st.lists(st.tuples(COORDINATES, COORDINATES, st.floats(1e-3, 10)), max_size=4),
)
def test_an_arena_is_read_as_it_was_written(walls: list, circles: list, tmp_path: Path) -> None:
    tables = np.array(walls).reshape(-1, 4), np.array(circles).reshape(-1, 3)
    if not (np.hypot(tables[0][:, 2] - tables[0][:, 0], tables[0][:, 3] - tables[0][:, 1]) > 0).all():
        return
    path = tmp_path / "mine.toml"
    path.write_text(arena_toml(Arena("mine", *tables)))
    found = get_arena(str(path))
    np.testing.assert_array_equal(found.walls, tables[0])
    np.testing.assert_array_equal(found.pillars, tables[1])


@SHARED
@given(
    center=st.tuples(st.floats(-9, 9), st.floats(-9, 9)), length=st.floats(0.1, 9), width=st.floats(0.1, 9),
    heading=st.floats(-7, 7),
)  # fmt: skip
def test_a_box_is_four_walls_around_its_centre(
    center: tuple[float, float], length: float, width: float, heading: float, tmp_path: Path
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(f"boxes = [{{center = {list(center)}, length = {length}, width = {width}, heading = {heading}}}]")
    walls = get_arena(str(path)).walls
    sides = np.hypot(walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1])
    np.testing.assert_allclose(sides, [length, width, length, width])
    np.testing.assert_allclose(walls[:, :2].mean(axis=0), center, atol=1e-12)
    along = (walls[0, :2] - walls[0, 2:]) / length
    np.testing.assert_allclose(along, [np.cos(heading), np.sin(heading)], atol=1e-9)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | TEXT | st.just(10**400),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["center", "up_to", "x"]), inner),
    max_leaves=6,
)
KEYS = st.sampled_from([
    "name", "control_period", "latency", "odometry", "footprint", "lidar", "drive", "lidar.rays", "lidar.noise",
    "lidar.rolling", "lidar.angle_min", "drive.max_speed", "drive.lag", "walls", "circles", "boxes", "wals",
])  # fmt: skip


def spelled(value: object) -> str:
    """A value as TOML spells it; what TOML has no word for is left as Python's, which is no TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(spelled, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {spelled(each)}" for key, each in value.items()) + "}"
    return repr(value)


@SHARED
@given(entries=st.dictionaries(KEYS, VALUES, max_size=4), kind=st.sampled_from(sorted(READERS)))
@example(entries={"latency": 10**400}, kind="profile")
@example(entries={"walls": [[0, 0, 10**400, 0]]}, kind="arena")
@example(entries={"circles": [[0, 0, math.nan]]}, kind="arena")
def test_whatever_a_file_holds_is_read_or_refused_in_one_sentence(entries: dict, kind: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("\n".join(f"{key} = {spelled(value)}" for key, value in entries.items()), encoding="utf-8")
    try:
        READERS[kind](str(path))
        said = f"{path}"
    except ConfigurationError as error:
        said = str(error)
    assert str(path) in said
    assert "\n" not in said


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"name = '\xff'", "is no TOML file: 'utf-8' codec can't decode byte 0xff"),
        (b"\x00", "is no TOML file"),
        (b"name = " + b"9" * 5000, "is no TOML file: Exceeds the limit"),
        (b"walls = " + b"[" * 5000, "is no TOML file"),
        (b"name = 'a'\nname = 'b'", "is no TOML file: Cannot overwrite a value"),
        (b"nam = 'a'", r"there is no key 'nam' \(did you mean 'name'\?\); allowed are name"),
    ],
)
def test_what_is_no_file_of_ours_is_refused(kind: str, content: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigurationError, match=f"^[^\n]*mine.toml:? {says}[^\n]*$"):
        READERS[kind](str(path))


@pytest.mark.parametrize("kind", READERS)
def test_a_folder_and_an_unknown_name_are_refused(kind: str, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").mkdir()
    with pytest.raises(ConfigurationError, match=r"mine.toml cannot be read: is a directory"):
        READERS[kind](str(tmp_path / "mine.toml"))
    with pytest.raises(ConfigurationError, match=rf"there is no {kind} 'rooom-6'.*and your own as FILE.toml"):
        READERS[kind]("rooom-6")


@given(st.text() | st.builds("{}:{}".format, st.sampled_from(["circle", "box"]), st.text("0123456789.x-e naif")))
def test_any_text_is_an_outline_or_refused_in_one_sentence(text: str) -> None:
    try:
        label, said = Footprint.parse(text).label, ""
        assert Footprint.parse(label).label == label
    except ConfigurationError as error:
        said = str(error)
    assert "\n" not in said
