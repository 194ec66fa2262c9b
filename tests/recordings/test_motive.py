from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from triform.evaluation import Scenario, Trajectory, measure
from triform.recordings.motive import axes_of_euler, axes_of_quaternion
from triform.recordings.resample import read_recordings
from triform.types import TriformError

#: Turns Motive's axes into ours: our x is its z, our y its x, our z its y.
MAP = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
EULER_ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")


@functools.cache
def driven():
    scenario = Scenario(profile="hardware", duration=8.0)
    return scenario.run(scenario.sample_starts(4, 1, 3), "expert-sensed", seed=3)[0]


def in_motive(poses):
    """Positions and rotations in Motive's frame of robots at ``poses`` (T, 3), which rock a little."""
    rng = np.random.default_rng(0)
    places = np.column_stack([poses[:, :2], np.full(len(poses), 0.15)]) @ MAP
    # Rocking about the robot's own y axis keeps its front where the heading says.
    ours = Rotation.from_euler("ZY", np.column_stack([poses[:, 2], rng.normal(0, 0.05, len(poses))]))
    return places, Rotation.from_matrix(MAP.T @ ours.as_matrix() @ MAP)


def write_take(path, trajectory, rotation="Quaternion", units="Meters", decimals=6, space="Global", version="1.23"):
    """Write a run as Motive does: bodies, and beside them their markers."""
    scale = {"Meters": 1, "Centimeters": 100, "Millimeters": 1000}.get(units, 1)
    settings = (
        f"Format Version,{version},Take Name,a take, of robots,Take Notes,,Capture Frame Rate,8.000000,Export Frame "
        "Rate,8.000000,Capture Start Time,2023-06-02 12.09.45.344 PM,Capture Start Frame,0,Total Frames in Take,65,"
        f"Total Exported Frames,65,Rotation Type,{rotation},Length Units,{units},Coordinate Space,{space}"
    )
    kinds, names, ids, parts, axes = (
        ["", "Type"],
        ["", "Name"],
        ["", "ID"],
        ["", ""],
        ["Frame", "Time (Seconds)"],
    )
    columns = []
    angle_axes = "XYZW" if rotation == "Quaternion" else rotation
    for robot in range(trajectory.poses.shape[2]):
        poses = trajectory.poses[0, :, robot]
        seen = np.isfinite(poses[:, 0])
        places, turns = in_motive(poses[seen])
        turned = turns.as_quat() if rotation == "Quaternion" else turns.as_euler(rotation, degrees=True)
        body = np.full((len(poses), 8), np.nan)[:, : len(angle_axes) + 4]
        body[seen] = np.column_stack([turned, scale * places, np.full(seen.sum(), 0.0003)])
        marker = np.full((len(poses), 4), np.nan)
        marker[seen] = np.column_stack([scale * places + 0.05, np.ones(seen.sum())])
        columns += [body, marker]
        for kind, name, part, axis in (
            ("Rigid Body", f"ep {robot}", "Rotation", angle_axes),
            ("Rigid Body", f"ep {robot}", "Position", "XYZ"),
            ("Rigid Body", f"ep {robot}", "Mean Marker Error", [""]),
            ("Rigid Body Marker", f"ep {robot}:Marker1", "Position", "XYZ"),
            ("Rigid Body Marker", f"ep {robot}:Marker1", "Marker Quality", [""]),
        ):
            for each in axis:
                kinds.append(kind)
                names.append(name)
                ids.append("6F3A4C")
                parts.append(part)
                axes.append(each)
    values = np.concatenate(columns, axis=1)
    lines = [settings, "", *(",".join(row) for row in (kinds, names, ids, parts, axes))]
    for frame, (time, row) in enumerate(zip(trajectory.time, values, strict=True)):
        cells = ["" if np.isnan(value) else f"{value:.{decimals}f}" for value in row]
        lines.append(",".join([str(frame), f"{time:.6f}", *cells]))
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode())
    return path


@pytest.mark.parametrize("rotation", ["Quaternion", *EULER_ORDERS])
@pytest.mark.parametrize("units", ["Meters", "Millimeters"])
def test_a_take_measures_as_the_run_that_it_shows(tmp_path, rotation, units):
    trajectory = driven()
    (recording,) = read_recordings(write_take(tmp_path / "take.csv", trajectory, rotation, units, decimals=12))
    assert recording.robots == ("ep 0", "ep 1", "ep 2", "ep 3")
    np.testing.assert_allclose(recording.trajectory.poses[..., :2], trajectory.poses[..., :2], atol=1e-9)
    away = recording.trajectory.poses[..., 2] - trajectory.poses[..., 2]
    np.testing.assert_allclose(np.cos(away), 1, atol=1e-9)
    expected, found = measure(trajectory), measure(recording.trajectory)
    for name, column in expected.items():
        np.testing.assert_allclose(found[name], column, rtol=0, atol=1e-9, err_msg=name)


def test_the_newest_version_has_a_line_of_parents(tmp_path):
    path = write_take(tmp_path / "take.csv", driven(), version="1.25")
    lines = path.read_bytes().split(b"\r\n")
    assert lines[4].startswith(b",ID,")
    lines.insert(5, b",Parent" + b"," * (lines[4].count(b",") - 1))
    path.write_bytes(b"\r\n".join(lines))
    (recording,) = read_recordings(path)
    np.testing.assert_allclose(recording.trajectory.poses[..., :2], driven().poses[..., :2], atol=1e-6)


def test_six_decimals_are_as_good_as_six_decimals(tmp_path):
    trajectory = driven()
    (recording,) = read_recordings(write_take(tmp_path / "take.csv", trajectory))
    np.testing.assert_allclose(recording.trajectory.poses[..., :2], trajectory.poses[..., :2], atol=1e-6)
    expected, found = measure(trajectory), measure(recording.trajectory)
    for name in ("formation_error", "min_distance", "converge_time", "strict", "edges"):
        np.testing.assert_allclose(found[name], expected[name], atol=2e-6, err_msg=name)


def test_blank_cells_are_gaps_and_bodies_come_and_go(tmp_path):
    whole = driven()
    poses = whole.poses.copy()
    poses[0, 30:33, 1] = np.nan
    poses[0, 50:, 3] = np.nan
    gappy = Trajectory(whole.time, poses, np.isfinite(poses[..., 0]), whole.commands)
    (recording,) = read_recordings(write_take(tmp_path / "take.csv", gappy))
    assert recording.trajectory.active[0, :, 1].all()
    assert recording.trajectory.active[0, :, 3].sum() == 50
    line = np.linspace(poses[0, 29, 1, :2], poses[0, 33, 1, :2], 5)
    np.testing.assert_allclose(recording.trajectory.poses[0, 29:34, 1, :2], line, atol=1e-6)
    assert [sentence.split(": ")[-1] for sentence in recording.changes] == ["robot ep 3 goes at 6.12 s"]


def swapped(path, ups):
    """Exchange the positions' columns of a take, so that they have another axis up."""
    lines = [line.split(",") for line in path.read_bytes().decode().split("\r\n")]
    kinds, parts, axes = lines[2], lines[5], lines[6]
    for row in lines[7:]:
        old = list(row)
        for index, (kind, part) in enumerate(zip(kinds, parts, strict=True)):
            if kind == "Rigid Body" and part == "Position" and index < len(row):
                row[index] = old[index + "XYZ".index(ups["XYZ".index(axes[index])]) - "XYZ".index(axes[index])]
    path.write_bytes("\r\n".join(",".join(row) for row in lines).encode())
    return path


def still(places, seconds=8.0):
    time = np.arange(0, seconds + 0.01, 0.125)
    poses = np.zeros((1, len(time), len(places), 3))
    poses[..., :2] = places
    return Trajectory(time, poses, np.ones(poses.shape[:3], bool), np.zeros((1, len(time) - 1, len(places), 3)))


TRIANGLE = [[0.0, 0.0], [1.0, 0.0], [0.5, 0.866]]


@pytest.mark.parametrize("places", [TRIANGLE, "driven"])
@pytest.mark.parametrize("ups", ["YXZ", "XZY"])
def test_positions_with_another_axis_up_than_attitudes_are_refused(tmp_path, places, ups):
    trajectory = driven() if places == "driven" else still(places)
    path = write_take(tmp_path / "take.csv", trajectory)
    assert len(read_recordings(path)) == 1
    with pytest.raises(TriformError, match="robots on a floor have nearly one height") as caught:
        read_recordings(swapped(path, ups))
    assert "\n" not in str(caught.value)


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 6), st.integers(0, 2**32 - 1), st.floats(-np.pi, np.pi))
def test_takes_of_any_formation_on_a_floor_are_read(tmp_path_factory, robots, seed, turn):
    rng = np.random.default_rng(seed)
    places = np.cumsum(np.abs(rng.normal(0.7, 0.2, (robots, 2))), axis=0)
    cos, sin = np.cos(turn), np.sin(turn)
    path = write_take(tmp_path_factory.mktemp("take") / "take.csv", still(places @ [[cos, sin], [-sin, cos]], 6.0))
    assert len(read_recordings(path)[0].robots) == robots


@pytest.mark.parametrize(("name", "encoding"), [("Prüfung für Köln", "cp1252"), ("実験、三角形", "shift_jis")])
def test_a_take_may_be_named_in_any_encoding(tmp_path, name, encoding):
    path = write_take(tmp_path / "take.csv", driven())
    text = path.read_bytes().decode()
    whole = read_recordings(path)[0].trajectory
    path.write_bytes(text.replace("a take, of robots", name).encode(encoding))
    np.testing.assert_array_equal(read_recordings(path)[0].trajectory.poses, whole.poses)


def test_seen_from_above_counter_clockwise_turns_and_triangles_stay_so():
    # A quarter turn about Motive's y axis, which points up: from its z axis, our x, to its x axis, our y.
    front, up = axes_of_quaternion(np.array([[0, np.sin(np.pi / 4), 0, np.cos(np.pi / 4)]]).T)
    np.testing.assert_allclose(front[:, 0], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(up[:, 0], [0, 1, 0], atol=1e-12)
    assert np.linalg.det(MAP) == pytest.approx(1)


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(-180, 180)] * 3), st.sampled_from(EULER_ORDERS))
def test_axes_are_those_of_scipy(angles, order):
    degrees = dict(zip("XYZ", angles, strict=True))
    turn = Rotation.from_euler(order, [degrees[axis] for axis in order], degrees=True)
    for front, up in (
        axes_of_euler(np.array([angles]).T, order),
        axes_of_quaternion(3 * turn.as_quat()[:, None]),
    ):
        np.testing.assert_allclose(front[:, 0], turn.apply([0, 0, 1]), atol=1e-12)
        np.testing.assert_allclose(up[:, 0], turn.apply([0, 1, 0]), atol=1e-12)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"version": "1.1"}, "format version '1.1'; 1.2 to 1.25 can be read"),
        ({"version": "1.26"}, "format version '1.26'; 1.2 to 1.25 can be read"),
        ({"units": "Inches"}, "length units 'Inches'; allowed are Meters, Centimeters, Millimeters"),
        ({"space": "Local"}, "coordinate space 'Local'; Global is needed"),
    ],
)
def test_exports_of_other_kinds_are_refused(tmp_path, options, says):
    path = write_take(tmp_path / "take.csv", driven(), **options)
    with pytest.raises(TriformError, match=says):
        read_recordings(path)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("Rotation Type,Quaternion", "Rotation Type,Matrix", "rotation type 'Matrix'"),
        ("Rigid Body", "Skeleton", "no rigid bodies"),
        ("Frame,", "Picture,", "no lines Type, Name and Frame"),
        (
            "Export Frame Rate,8.0",
            "Export Frame Rate,120.0",
            "export frame rate of 120 Hz, but 8 records per second",
        ),
        ("Format Version,1.23", "Format Version;1.23", "has semicolons between its columns; commas are needed"),
        (",X,Y,Z,W,", ",X,Z,W,Y,", "is tilted by"),
        (
            "\r\n0,0.000000,",
            "\r\n0,0.000000,9",
            "the rigid body .ep 0. are no quaternions of length 1",
        ),
        (",X,Y,Z,W,", ",X,Y,Z,V,", "the rigid body 'ep 0' has no column Rotation W"),
        ("\r\n7,", "\r\n7,late", "line 15, column time: 'late0.875000' is not a number"),
    ],
)
def test_damaged_exports_are_refused(tmp_path, old, new, says):
    path = write_take(tmp_path / "take.csv", driven())
    text = path.read_bytes().decode()
    assert old in text
    path.write_bytes(text.replace(old, new).encode())
    with pytest.raises(TriformError, match=says):
        read_recordings(path)


def test_another_axis_up_is_noticed(tmp_path):
    path = write_take(tmp_path / "take.csv", driven())
    text = path.read_text().replace(",X,Y,Z,W,", ",X,Z,Y,W,")
    path.write_text(text)
    with pytest.raises(TriformError, match=r"is tilted by .* degrees at .* s; robots on the ground"):
        read_recordings(path)
