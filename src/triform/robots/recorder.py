"""Recordings of a driving robot: files that grow line by line, and never stand in the way of driving."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from triform.files import cannot_write, make_folder, write_atomically
from triform.geometry.frames import body_to_world, wrap_angle
from triform.robots.laser_scan import Turn
from triform.robots.real import Step
from triform.robots.scan_file import SCANS_FILE, scan_columns
from triform.simulation.odometry import relative_poses
from triform.types import FloatArray, TriformError
from triform.version import __version__

STEPS_FILE, DRIVE_FILE = "steps.csv", "drive.json"
#: Columns of a recording of poses; x, y and heading are in one frame for all robots [s, 1, m, m, rad].
POSE_COLUMNS = ("time", "robot", "x", "y", "heading")

_STEP_COLUMNS = (*POSE_COLUMNS, "u_x", "u_y", "omega", "scan_age", "latency", "fresh", "late")


class CsvLog:
    """A CSV file of numbers, written line by line.

    A line that cannot be written, because the disk is full, is taken back; the file then ends with the line before it,
    one warning is given, and later lines are dropped.
    """

    def __init__(self, path: Path, columns: Sequence[str], warn: Callable[[str], None]) -> None:
        """Begin a file that does not exist yet.

        Args:
            path: Where to.
            columns: Names of the columns.
            warn: Called once with a sentence if the file cannot go on.

        Raises:
            TriformError: The file exists or cannot be written.
        """
        self._path, self._warn = path, warn
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError as error:
            raise TriformError(f"{path} exists; choose another place for this recording") from error
        except OSError as error:
            raise cannot_write(path, error) from error
        self._size = 0
        self._going_on = True
        self._append(",".join(columns))

    def write(self, numbers: Sequence[float], digits: int = 6) -> None:
        """Append a line of numbers; those that are not whole get ``digits`` decimals."""
        if self._going_on:
            self._append(",".join(str(each) if isinstance(each, int) else f"{each:.{digits}f}" for each in numbers))

    def close(self) -> None:
        """End the file."""
        self._file.close()

    def _append(self, line: str) -> None:
        data = line.encode() + b"\n"
        try:
            # A disk that fills up takes a part of the line and says nothing.
            self._going_on = self._file.write(data) == len(data)
            reason = "no space left"
        except OSError as error:
            self._going_on = False
            reason = (error.strerror or str(error)).lower()
        if self._going_on:
            self._size += len(data)
            return
        with suppress(OSError):
            self._file.truncate(self._size)
        self._warn(f"{self._path} ends here, and the robot drives on: {reason}")


class Recorder:
    """Writes what one robot saw, did and, by its wheels, where it went.

    ``steps.csv`` has a row per command: its time, the pose by odometry in the frame of the start (``nan`` where the
    wheels do not say), the command as sent, the age of its scan when it was used, the time from the end of that scan
    until the base had the command, and whether the scan was fresh and the command late. ``scans.csv`` has a row per
    scan, with the intensities of its returns where the LiDAR says them, and ``drive.json`` says at the end how the
    robot was driven. Times are Unix times, which all robots share.
    """

    def __init__(
        self, folder: Path, rays: int, robot: int, start: Sequence[float], warn: Callable[[str], None]
    ) -> None:
        """Begin a recording.

        Args:
            folder: Where to; it is made.
            rays: Rays of a scan.
            robot: Number of the robot in its team.
            start: Where the robot starts, (x, y, heading) in a frame of the user's choice [m, m, rad].
            warn: Called with a sentence when something cannot be recorded any more.

        Raises:
            TriformError: The folder holds a recording or cannot be written.
        """
        make_folder(folder)
        if any((folder / name).exists() for name in (STEPS_FILE, SCANS_FILE, DRIVE_FILE)):
            raise TriformError(f"{folder} already holds a recording; choose another folder for this one")
        self._folder, self._robot, self._warn = folder, robot, warn
        self._start = np.asarray(start, dtype=np.float64)
        # Added once for all: the time of day may be set while the robot drives.
        self._epoch = time.time() - time.monotonic()
        self._origin: FloatArray | None = None
        self._turn: Turn | None = None
        self._steps = CsvLog(folder / STEPS_FILE, _STEP_COLUMNS, warn)
        self._rays, self._scans = rays, CsvLog(folder / SCANS_FILE, scan_columns(rays), warn)

    def add(self, step: Step) -> None:
        """Write a step, and its scan if it is a new one."""
        turn = step.turn
        if turn is not None and turn is not self._turn:
            bright = np.full(self._rays, np.nan) if turn.intensities is None else turn.intensities
            self._scans.write([turn.started + self._epoch, turn.ended + self._epoch, *turn.ranges, *bright], 4)
            self._turn = turn
        pose = self._placed(step.pose)
        flags = int(not step.blind), int(step.late)
        times = step.scan_age, step.latency
        self._steps.write([step.sent + self._epoch, self._robot, *pose, *step.command, *times, *flags])

    def finish(self, facts: dict[str, Any]) -> None:
        """End the recording and write ``drive.json``: ``facts`` and the versions that were used."""
        self._steps.close()
        self._scans.close()
        modules = {module.__name__: module.__version__ for module in (np, onnxruntime)}
        described = {**facts, "versions": {"triform": __version__, "python": platform.python_version(), **modules}}
        text = json.dumps(described, indent=2, allow_nan=False, default=str)
        try:
            write_atomically(self._folder / DRIVE_FILE, f"{text}\n".encode())
        except TriformError as error:
            self._warn(str(error))

    def _placed(self, pose: FloatArray | None) -> FloatArray:
        """Pose of the wheels in the frame of the start, shape (3,)."""
        if pose is None:
            return np.full(3, np.nan)
        if self._origin is None:
            self._origin = pose
        come = relative_poses(pose, self._origin, np.ones((), dtype=np.bool_))
        place = self._start[:2] + body_to_world(come[:2], self._start[2])
        return np.append(place, wrap_angle(self._start[2] + come[2]))
