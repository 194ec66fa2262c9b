"""What users hand in: what has one meaning is converted, the rest is refused in a sentence that says what is needed."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path, PurePosixPath
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import triform
from triform.control import ControllerSpec
from triform.evaluation import Trajectory, measure
from triform.evaluation.scenario import Scenario
from triform.experiments.evaluate import EvaluateConfig
from triform.geometry import assess, body_to_world, edge_error, gabriel_graph, smallest_distance, wrap_angle
from triform.perception import occupancy_maps
from triform.simulation import (
    IDEAL,
    ROBOMASTER_EP,
    Arena,
    Drive,
    World,
    cast_scans,
    get_profile,
    integrate,
    limit_twists,
    make_world,
    sample_addition,
    sample_starts,
    steer,
)
from triform.types import ConfigurationError, MapConfig, PrivilegedView, Scan, ScanConfig, TriformError, View, converted

DTYPES = ["<f2", ">f2", "<f4", ">f4", "<f8", ">f8", "g"]
LAYOUTS = ["plain", "fortran", "every second", "backwards", "read-only", "misaligned", "lists"]
CONFIG, DRIVE = ScanConfig(rays=32), Drive(max_axis_speed=0.3, max_acceleration=1.0, lag=0.1)


def presented(values: np.ndarray, dtype: str, layout: str) -> Any:
    """The same numbers, which fit into half precision, or truth values, in another type and layout."""
    array = values.copy() if values.dtype == np.bool_ else values.astype(dtype)
    if layout == "lists":
        return array.tolist()
    if layout == "fortran":
        return np.asfortranarray(array)
    if layout == "every second":
        return np.repeat(array, 2, axis=-1)[..., ::2]
    if layout == "backwards":
        return np.ascontiguousarray(array[..., ::-1])[..., ::-1]
    if layout == "misaligned":
        shifted = np.empty(array.nbytes + 1, dtype=np.uint8)[1:].view(array.dtype).reshape(array.shape)
        shifted[...] = array
        return shifted
    array.setflags(write=layout == "plain")
    return array


@st.composite
def teams(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, str, str]:
    """Poses (2, N, 3) in eighths and truth values (2, N), and how they are handed in."""
    robots = draw(st.integers(1, 5))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    poses = rng.integers(-24, 24, (2, robots, 3)) / 8
    return poses, rng.random((2, robots)) < 0.8, draw(st.sampled_from(DTYPES)), draw(st.sampled_from(LAYOUTS))


def a_view(poses: Any, active: Any) -> list[np.ndarray]:
    """What a view makes of what it is given: arrays as kernels take them."""
    ranges = np.ones((*np.shape(active), 32), dtype=">f4")[..., ::-1]
    noise = np.ones((*np.shape(active), 2), dtype=np.float16)
    view = PrivilegedView(Scan(ranges, CONFIG), active, np.float32(0.5), poses, noise=noise, odometry=poses)
    assert type(view.time) is float
    arrays = [view.scans.ranges, view.active, view.noise, view.odometry, view.poses]
    assert all(each.flags.carray and each.dtype.isnative for each in arrays)
    assert [each.dtype for each in arrays] == [np.float32, np.bool_, np.float64, np.float64, np.float64]
    return arrays


def a_run(poses: Any, active: Any) -> Trajectory:
    """Two runs of 6 s in which all robots rest."""
    still = np.zeros((2, 60, np.shape(active)[1], 3), dtype=np.float32)
    rows = [[[each] * 61 for each in values] for values in (poses, active)]
    return Trajectory(0.1 * np.arange(61), rows[0], rows[1], still)


def a_world(poses: Any, active: Any) -> list[np.ndarray]:
    world = World(poses, IDEAL, Arena("mine", walls=np.float32([[3, 3, 4, 3]])), active=active)
    world.apply(poses, np.float32(0.125))
    world.add_robot(np.int32(0), np.array([9, 9, 0], dtype=np.int8))
    return [world.poses, world.min_distance, world.observe().scans.ranges]


#: Every entry by poses (2, N, 3), points (2, N, 2) and truth values (2, N).
ENTRIES: dict[str, Callable[[Any, Any, Any], Any]] = {
    "of_scan": lambda poses, points, active: View.of_scan(poses).scans.ranges,
    "occupancy_maps": lambda poses, points, active: occupancy_maps(Scan(poses, ScanConfig(rays=3)), MapConfig(20)),
    "view": lambda poses, points, active: a_view(poses, active),
    "integrate": lambda poses, points, active: integrate(poses, poses, np.float32(0.5)),
    "limit_twists": lambda poses, points, active: limit_twists(poses, DRIVE),
    "steer": lambda poses, points, active: steer(poses, poses, poses, DRIVE, 0.25),
    "wrap_angle": lambda poses, points, active: wrap_angle(poses),
    "body_to_world": lambda poses, points, active: body_to_world(points, np.float32(0.5)),
    "gabriel_graph": lambda poses, points, active: gabriel_graph(points, np.float32(2), active),
    "assess": lambda poses, points, active: list(vars(assess(points, np.int64(1), 2, active)).values()),
    "edge_error": lambda poses, points, active: edge_error(points, 1, 2, active),
    "smallest_distance": lambda poses, points, active: smallest_distance(points, active),
    "world": lambda poses, points, active: a_world(poses, active),
    "cast_scans": lambda poses, points, active: cast_scans(poses, active, ROBOMASTER_EP, Arena.open(), CONFIG),
    "measure": lambda poses, points, active: list(measure(a_run(poses, active), np.float32(1)).values()),
    "sample_addition": lambda poses, points, active: sample_addition(poses[0], active[0], np.random.default_rng(1)),
}


def outcome(entry: Callable[..., Any], *given_values: Any) -> Any:
    """What an entry returns, or the sentence with which it refuses."""
    try:
        found = entry(*given_values)
    except TriformError as error:
        return str(error)
    return [np.asarray(each) for each in (found if isinstance(found, list | tuple) else [found])]


@pytest.mark.parametrize("name", ENTRIES)
@settings(deadline=None, max_examples=25)
@given(teams())
def test_equal_numbers_give_equal_results_in_any_type_and_layout(
    name: str, team: tuple[np.ndarray, np.ndarray, str, str]
) -> None:
    poses, active, *form = team
    points = poses[..., :2].copy()
    expected = outcome(ENTRIES[name], poses, points, active)
    found = outcome(ENTRIES[name], *(presented(each, *form) for each in (poses, points, active)))
    if isinstance(expected, str):
        assert found == expected
        return
    assert not isinstance(found, str), found
    for first, second in zip(expected, found, strict=True):
        assert first.shape == second.shape
        np.testing.assert_array_equal(second.astype(first.dtype), first)


BAD: dict[str, Any] = {
    "text": np.full((2, 1, 3), "1"),
    "complex": np.ones((2, 1, 3), dtype=complex),
    "objects": np.array([[[None, 1.0, 2.0]]] * 2),
    "ragged": [[[1.0, 2.0, 3.0]], [[1.0]]],
    "dates": np.zeros((2, 1, 3), dtype="M8[D]"),
    "truth values": np.ones((2, 1, 3), dtype=bool),
    "masked": np.ma.masked_equal(np.ones((2, 1, 3)), 1.0),
    "nothing": None,
    "a mapping": {"poses": 1},
    "large numbers": [[[10**400, 0, 0]]] * 2,
}


@pytest.mark.parametrize("kind", BAD)
def test_what_is_no_numbers_is_refused_in_a_sentence(kind: str) -> None:
    for name, entry in ENTRIES.items():
        # These two take rows out of what they are given before anything can be checked.
        if name not in ("measure", "sample_addition"):
            with pytest.raises(ConfigurationError, match=r"^[^\n]+$"):
                entry(BAD[kind], BAD[kind], np.ones((2, 1), dtype=bool))


@pytest.mark.parametrize("active", [[[1]], [["yes"]], [[None]], np.ones((1, 1)), [[True], [True, False]]], ids=str)
def test_only_truth_values_say_who_is_active(active: Any) -> None:
    with pytest.raises(ConfigurationError, match="flags of active robots are"):
        View(Scan(np.ones((1, 1, 32)), CONFIG), active, 0.0)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: View(np.ones((1, 1, 32)), [[True]], 0.0), "a Scan is needed"),
        (lambda: Scan(np.ones(32), 32), "config of a scan is 32; a ScanConfig is needed"),
        (lambda: View(Scan(np.ones((1, 1, 32)), CONFIG), [[True]], "now"), "time of a view is 'now'; a number is"),
        (lambda: View(Scan(np.ones((1, 1, 32)), CONFIG), [[True, True]], 0.0), r"\(B, N, R\) and \(B, N\) are needed"),
        (lambda: World(np.zeros((1, 2, 3)), "ideal"), "profile is 'ideal'; a Profile is needed"),
        (lambda: World(np.zeros((1, 2, 3)), IDEAL, "open"), "arena is 'open'; a Arena is needed"),
        (lambda: make_world(robots=4.5), "robots is 4.5; a whole number is needed"),
        (lambda: make_world(robots="9"), "robots is '9'; a whole number is needed"),
        (lambda: make_world(distance="1"), "distance is '1'; a number is needed"),
        (lambda: make_world(seed=None), "seed is None; a whole number is needed"),
        (lambda: World(np.zeros((1, 2, 3)), IDEAL, seeds=[-1]), "seed is -1; it must not be negative"),
        (lambda: World(np.zeros((1, 2, 3)), IDEAL, seeds=["1"]), "seed is '1'; a whole number is needed"),
        (lambda: get_profile(None), "profile is None; a text is needed"),
        (lambda: make_world().apply(np.zeros((1, 9, 3)), "1"), "duration is '1'; a number is needed"),
        (lambda: make_world().remove_robot(0, 1.0), "robot is 1.0; a whole number is needed"),
        (lambda: assess(np.zeros((3, 2)), distance="1"), "distance is '1'; a number is needed"),
        (lambda: gabriel_graph(np.zeros((3, 2)), "2"), "max_range is '2'; a number is needed"),
        (lambda: gabriel_graph(np.zeros((3, 2)), 2.0, [True, False]), r"active has shape \(2,\); \(3,\) is needed"),
        (lambda: Trajectory(np.arange(3), np.zeros((1, 3, 2, 3)), np.ones((1, 3, 2), bool), 0), "a trajectory has"),
    ],
)
def test_the_sentence_says_what_is_needed(make: Callable[[], object], says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        make()


def test_numbers_of_numpy_are_numbers() -> None:
    plain = make_world(5, 3, 2, "ideal", "open", 1.0)
    numpys = make_world(np.int64(5), np.uint8(3), np.int16(2), np.str_("ideal"), np.str_("open"), np.float32(1))
    np.testing.assert_array_equal(plain.poses, numpys.poses)
    np.testing.assert_array_equal(sample_starts(4, 2, 1), sample_starts(np.int8(4), np.int8(2), np.int8(1)))


def test_an_evaluation_takes_text_for_paths_and_numpys_numbers() -> None:
    config = EvaluateConfig(robots=np.array([5, 7]), runs=np.int64(3), json="x.json", starts=PurePosixPath("s.npy"))
    assert config == EvaluateConfig(robots=(5, 7), runs=3, json=Path("x.json"), starts=Path("s.npy"))
    assert [type(each) for each in (*config.robots, config.runs)] == [int] * 3
    assert [type(each) for each in (config.json, config.starts)] == [type(Path())] * 2


#: Values that attributes without a default have, where they matter.
REQUIRED: dict[str, dict[str, Any]] = {
    "Collect": {"out": "data"},
    "Train": {"out": "runs"},
    "Event": {"kind": "join"},
    "Composition": {"profiles": (IDEAL,)},
    "Footprint": {"shape": "box", "length": 0.4, "width": 0.2},
    "MeasureConfig": {"files": ("run.csv",)},
    "Measure": {"files": ("run.csv",)},
    "NoiseBand": {"up_to": 1.0},
    "OrcaSettings": {"radius": 0.2},
    "Setup": {"scenario": Scenario(), "controller": ControllerSpec(), "robots": 9, "seed": 7},
    "Profile": {"name": "mine"},
    "Teacher": {"name": "expert"},
    "LidarModel": {"name": "mine", "samples_per_second": 4500.0, "period": 0.1, "range_min": 0.1, "range_max": 8.0},
}
#: Not configurations: they hold arrays, or are made of others that are checked.
HELD = {
    "Manifest",
    "Shard",
    "Trajectory",
    "Scan",
    "View",
    "PrivilegedView",
    "MixedView",
    "StateBuffer",
    "LaserScan",
    "PolicySpec",
    "TrainConfig",
}
SIMPLE = (bool, int, float, str, Path)


def configurations() -> list[type]:
    """All dataclasses of the package that check what they are made of."""
    found = []
    for each in pkgutil.walk_packages(triform.__path__, "triform."):
        if each.name.endswith("__main__"):
            continue
        try:
            module = importlib.import_module(each.name)
        except ModuleNotFoundError:
            # Of an extra that is not installed.
            continue
        for kind in vars(module).values():
            checked = isinstance(kind, type) and is_dataclass(kind) and hasattr(kind, "__post_init__")
            if checked and kind.__module__ == each.name and kind.__name__ not in HELD and kind.__name__[0] != "_":
                found.append(kind)
    return sorted(found, key=lambda kind: (kind.__module__, kind.__name__))


def simple(kind: Any) -> Any:
    """The simple type that an attribute declares, alone, or ``None``, or a tuple of it."""
    inner = [each for each in get_args(kind) if each not in (NoneType, ...)]
    if get_origin(kind) is tuple and get_args(kind)[1:] != (...,):
        return None
    return kind if kind in SIMPLE else simple(inner[0]) if len(inner) == 1 else None


def test_every_configuration_checks_the_types_of_its_values() -> None:
    checked = 0
    kinds = configurations()
    assert len(kinds) > 30
    for kind in kinds:
        given_values = REQUIRED.get(kind.__name__, {})
        missing = {each.name for each in fields(kind) if each.default is each.default_factory is MISSING}
        if missing - set(given_values):
            pytest.fail(f"{kind.__name__} has attributes without a default that this test does not know: {missing}")
        kind(**given_values)
        hints = get_type_hints(kind)
        for each in fields(kind):
            wanted = simple(hints[each.name])
            if wanted is not None:
                wrong: Any = b"1" if wanted in (str, Path) else "1"
                for bad in (wrong, object(), [wrong], {1: 2}):
                    with pytest.raises(ConfigurationError, match=each.name):
                        kind(**given_values | {each.name: bad})
                checked += 1
    assert checked > 150


@given(st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False, width=32), st.booleans(), st.text())
def test_conversion_keeps_values(whole: int, number: float, flag: bool, text: str) -> None:
    for value, kind in ((np.int64(whole), int), (np.int64(whole), float), (np.float32(number), float), (flag, bool)):
        assert converted("x", value, kind) == value
    assert type(converted("x", np.int64(whole), int)) is int
    assert type(converted("x", np.float32(number), float)) is float
    assert converted("x", np.bool_(flag), bool) is flag
    assert converted("x", text, str) == text
    assert converted("x", [whole, whole], tuple[int, ...]) == (whole, whole)
    assert converted("x", None, int | None) is None
    for value, kind in ((flag, int), (flag, float), (whole, bool), (number, int), (text, float), (whole, str)):
        with pytest.raises(ConfigurationError, match="x is "):
            converted("x", value, kind)
    with pytest.raises(ConfigurationError, match="x is 1"):
        converted("x", 10**400, float)
