"""Recordings of the motion capture system OptiTrack: the CSV export of Motive, format versions 1.2 to 1.25.

Motive's world is right-handed with y up. Ours is the same one with its axes renamed in a cycle, so that nothing is
mirrored: x is Motive's z, y is Motive's x, and up is Motive's y. The front of a robot is the z axis of its rigid body,
so a body that was defined while its robot faced along Motive's z axis has the robot's own heading.
"""

from __future__ import annotations

import csv
import re
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from triform.recordings.formats import RawRun, encoding_of, read_cells, require_commas, wide_run
from triform.types import FloatArray, TriformError

#: How a file begins.
SIGNATURE = "Format Version"

_METRES = {"Meters": 1.0, "Centimeters": 0.01, "Millimeters": 0.001}
_EULER_ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")
#: The headings of columns are within so many lines.
_HEAD = 20
#: A robot on the ground is tilted by less [rad]; one that is not has another axis up.
_LARGEST_TILT = np.pi / 4
#: On a floor, heights of robots differ by less [m]. By more than the second they differ only where positions have
#: another axis up along which they differ less, and a robot's own height changes by less than the third.
_LARGEST_STEP, _LEAST_STEP, _LARGEST_RISE = 0.5, 0.2, 0.1
#: Largest error of the length of a quaternion, and of the rate of frames, as a share.
_LARGEST_ERROR = 0.1


# Numbers near the end of floating point are refused by what is made of them.
@np.errstate(over="ignore", invalid="ignore")
def read_motive(path: Path) -> list[RawRun]:
    """Read the rigid bodies of a take; markers and skeletons are ignored.

    Raises:
        TriformError: The file is no export of this kind, has no rigid bodies, or they are not upright.
    """
    encoding = encoding_of(path)
    with path.open(newline="", encoding=encoding) as file:
        reader = csv.reader(file)
        head: list[list[str]] = []
        for row in reader:
            head.append([cell.strip() for cell in row])
            if head[-1][:1] == ["Frame"] or len(head) == _HEAD:
                break
        lines = reader.line_num
    require_commas(path, head[0])
    names = (SIGNATURE, "Rotation Type", "Length Units", "Coordinate Space", "Export Frame Rate")
    version, rotation, units, space, rate = (_setting(head[0], name) for name in names)
    axes = "XYZW" if rotation == "Quaternion" else "XYZ"
    if not re.fullmatch("1[.]2[0-5]?", version):
        raise TriformError(f"{path} is a Motive export of format version {version!r}; 1.2 to 1.25 can be read")
    if units not in _METRES:
        raise TriformError(f"{path} has length units {units!r}; allowed are {', '.join(_METRES)}")
    if space not in ("", "Global"):
        raise TriformError(f"{path} has the coordinate space {space!r}; Global is needed")
    if rotation != "Quaternion" and rotation not in _EULER_ORDERS:
        raise TriformError(f"{path} has rotation type {rotation!r}; Quaternion or an order such as XYZ is needed")
    wanted = {1: "time"}
    bodies = _bodies(path, head)
    for body, columns in bodies.items():
        for part in [*product(["Rotation"], axes), *product(["Position"], "XYZ")]:
            if part not in columns:
                raise TriformError(f"{path}: the rigid body {body!r} has no column {' '.join(part)}")
            wanted[columns[part]] = " ".join([body, *part])
    table = read_cells(path, encoding, lines, len(head[-1]), wanted)
    time = table["time"].to_numpy()
    _refuse_other_rate(path, time, rate)
    positions = np.stack(
        [[table[f"{body} Position {axis}"].to_numpy() * _METRES[units] for axis in "XYZ"] for body in bodies]
    )
    _refuse_other_axis(path, positions)
    poses = []
    for body, (x, _, z) in zip(bodies, positions, strict=True):
        turn = np.stack([table[f"{body} Rotation {axis}"].to_numpy() for axis in axes])
        if rotation == "Quaternion" and (np.abs(np.linalg.norm(turn, axis=0) - 1) > _LARGEST_ERROR).any():
            raise TriformError(f"{path}: the rotations of the rigid body {body!r} are no quaternions of length 1")
        front, up = axes_of_quaternion(turn) if rotation == "Quaternion" else axes_of_euler(turn, rotation)
        tilt = np.arccos(np.clip(up[1], -1, 1))
        if (tilt > _LARGEST_TILT).any():
            moment = int(np.argmax(tilt > _LARGEST_TILT))
            raise TriformError(
                f"{path}: the rigid body {body!r} is tilted by {np.degrees(tilt[moment]):.0f} degrees at "
                f"{time[moment]:g} s; robots on the ground and an export with the y axis up are needed"
            )
        poses.append(np.stack([z, x, np.arctan2(front[0], front[2])], axis=1))
    return [wide_run(str(path), time, list(bodies), np.stack(poses, axis=1))]


def _refuse_other_rate(path: Path, time: FloatArray, rate: str) -> None:
    """Refuse a take whose times are not those of its rate of frames [Hz], where its first line has one."""
    try:
        said = float(rate)
    except ValueError:
        return
    steps = np.diff(time)
    found = 1 / np.median(steps) if len(steps) and np.median(steps) > 0 else said
    if not abs(found - said) <= _LARGEST_ERROR * said:
        raise TriformError(
            f"{path} has an export frame rate of {said:g} Hz, but {found:.4g} records per second; are times in seconds?"
        )


def _refuse_other_axis(path: Path, positions: FloatArray) -> None:
    """Refuse positions that have another axis up than y: on a floor all heights are nearly one.

    Args:
        path: The file, for the message.
        positions: Positions of every body, shape (N, 3, T) [m]; ``NaN`` where it was not seen.
    """
    seen = [body[:, np.isfinite(body).all(axis=0)] for body in positions if np.isfinite(body).all(axis=0).any()]
    if not seen:
        return
    middles = np.array([np.median(body, axis=1) for body in seen])
    apart = np.ptp(middles, axis=0)
    moved = np.concatenate([body - middle[:, None] for body, middle in zip(seen, middles, strict=True)], axis=1)
    rise = np.subtract(*np.quantile(moved, [0.75, 0.25], axis=1))
    if (
        apart[1] > _LARGEST_STEP
        or _LEAST_STEP < apart[1] > min(apart[0], apart[2])
        or _LARGEST_RISE < rise[1] > min(rise[0], rise[2])
    ):
        x, y, z = np.maximum(apart, rise)
        raise TriformError(
            f"{path}: along X, Y and Z the positions of its rigid bodies differ by {x:.2f}, {y:.2f} and {z:.2f} m; "
            "robots on a floor have nearly one height, so positions and rotations with the y axis up are needed"
        )


def axes_of_quaternion(quaternion: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where the z and the y axis of bodies point, shape (3, T) each; quaternions x, y, z, w of shape (4, T)."""
    with np.errstate(invalid="ignore"):
        x, y, z, w = quaternion / np.linalg.norm(quaternion, axis=0)
    front = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    up = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
    return front, up


def axes_of_euler(angles: FloatArray, order: str) -> tuple[FloatArray, FloatArray]:
    """Return where the z and the y axis of bodies point, shape (3, T) each.

    Args:
        angles: Angles about x, y and z [deg], shape (3, T).
        order: Order of the turns, each about an axis of the body as it is by then.
    """
    front, up = (np.repeat(np.array(axis)[:, None], angles.shape[1], axis=1) for axis in ([0.0, 0, 1], [0.0, 1, 0]))
    for axis in reversed(order):
        about = "XYZ".index(axis)
        cos, sin = np.cos(np.radians(angles[about])), np.sin(np.radians(angles[about]))
        first, second = (about + 1) % 3, (about + 2) % 3
        for vector in (front, up):
            vector[first], vector[second] = (
                cos * vector[first] - sin * vector[second],
                sin * vector[first] + cos * vector[second],
            )
    return front, up


def _setting(cells: list[str], name: str) -> str:
    """Return what the first line says about ``name``; empty if nothing."""
    # Not by pairs: a name of a take may hold a comma.
    return cells[cells.index(name) + 1] if name in cells[:-1] else ""


def _bodies(path: Path, head: list[list[str]]) -> dict[str, dict[Any, int]]:
    """Return the places of the columns of every rigid body, by (Rotation or Position, axis)."""
    labelled = {row[1]: row for row in head[1:] if len(row) > 2}
    if head[-1][:1] != ["Frame"] or not {"Type", "Name"} <= labelled.keys():
        raise TriformError(f"{path} has no lines Type, Name and Frame above its values, as exports of Motive have")
    bodies: dict[str, dict[Any, int]] = {}
    for index, (kind, name, part, axis) in enumerate(
        zip(labelled["Type"], labelled["Name"], head[-2], head[-1], strict=False)
    ):
        if kind == "Rigid Body":
            bodies.setdefault(name, {})[part, axis] = index
    if not bodies:
        raise TriformError(f"{path} has no rigid bodies; export the take with rigid bodies")
    return bodies
