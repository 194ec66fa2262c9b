"""Kept runs of robots that ``triform drive`` drives and ``triform emulate`` emulates."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from triform.evaluation.metrics import RunTable
from triform.evaluation.rollout import Trajectory
from triform.evaluation.senses import Senses
from triform.files import refuse_device
from triform.recordings.description import LidarTable, RunSetting, Source
from triform.recordings.kept import Writers, keep_runs
from triform.report.output import plain
from triform.robots.drive import DriveConfig
from triform.robots.emulate import EmulateConfig, Emulation
from triform.robots.recorder import DRIVE_FILE, STEPS_FILE
from triform.simulation import Arena
from triform.types import FloatArray, TriformError

#: Columns of the steps of a drive that are kept.
_KEPT = ("time", "x", "y", "heading", "u_x", "u_y", "omega")


def keep_until_signal(
    paths: tuple[Path | None, ...],
    source: Source,
    run: Callable[[], object],
    write: Callable[[Writers], None],
    say: Callable[[str], object],
) -> None:
    """Run robots until they end or a signal ends them, and keep what happened.

    Args:
        paths: Where to, as ``keep_runs``; nothing is kept if all are ``None``.
        source: Where poses come from.
        run: Runs the robots.
        write: Writes what happened.
        say: Hears where it is kept.

    Raises:
        SystemExit: A signal ended the robots; what happened is kept by then.
    """
    named = [str(path) for path in paths if path is not None]
    if not named:
        run()
        return
    ended = None
    with keep_runs(*paths, source=source) as writer:
        try:
            run()
        except SystemExit as error:
            ended = error
        write(writer)
    say(f"kept in {' and '.join(named)}")
    if ended is not None:
        raise ended


class EmulationLog:
    """True poses, and the commands that the bases hold, of emulated robots."""

    def __init__(self) -> None:
        """Begin without a record."""
        self._records: list[tuple[float, FloatArray, FloatArray]] = []
        self._measures: dict[str, FloatArray] = {}

    def add(self, emulation: Emulation) -> None:
        """Take a record."""
        world = emulation.world
        self._records.append((round(emulation.time, 9), emulation.poses.copy(), emulation.commands))
        contacts = {"min_distance": world.min_distance, "collision": world.collided, "hit_arena": world.hit_arena}
        self._measures = {name: np.array(values) for name, values in contacts.items()}

    @property
    def trajectory(self) -> Trajectory:
        """All records as one run.

        Raises:
            TriformError: There are less than two.
        """
        if len(self._records) < 2:
            raise TriformError("nothing is kept, because the robots were emulated for less than two records")
        time, poses, commands = (np.array(each) for each in zip(*self._records, strict=True))
        return Trajectory(time, poses[None], np.ones((1, *poses.shape[:2]), np.bool_), commands[None, :-1])

    @property
    def contacts(self) -> RunTable:
        """Smallest distance, and contacts, in the whole world so far, one row."""
        return dict(self._measures)

    def write(self, writer: Writers, config: EmulateConfig) -> None:
        """Write all records as one run, as ``trajectory``."""
        setting = RunSetting(config.distance, config.kind.footprint, config.surroundings)
        writer.add(self.trajectory, setting, {"run": np.array([config.index]), **self._measures})
        writer.describe(plain(asdict(config)))


def with_senses(run: Trajectory, moments: FloatArray, drives: Sequence[Trajectory]) -> Trajectory:
    """Return a run of emulated robots with what the newest step of each drive saw at every record.

    Args:
        run: The run, B = 1, N robots.
        moments: Unix time of every record [s], shape (T,).
        drives: What ``triform drive`` kept of each robot with its scans, by Unix time.
    """
    found = []
    for each in drives:
        steps = np.maximum(np.searchsorted(each.time, moments, side="right") - 1, 0)
        found += [own.part(slice(None), steps) for own in each.senses]
    return replace(run, senses=(found[0].joined(found[1:], axis=2),))


def write_drive(writer: Writers, folder: Path, config: DriveConfig, senses: Sequence[Senses] = ()) -> None:
    """Write what ``triform drive`` recorded of one robot as one run: poses by odometry, and commands.

    Args:
        writer: Where to.
        folder: The recording.
        config: How the robot was driven.
        senses: What its controller saw in every step, B = N = 1; empty if that is not kept.

    Raises:
        TriformError: The recording cannot be read, or has less than two steps.
    """
    path = folder / STEPS_FILE
    try:
        refuse_device(path)
        with path.open(encoding="utf-8") as file:
            columns = file.readline().strip().split(",")
            rows = np.array([line.split(",") for line in file if line.endswith("\n")], np.float64)
        settings = json.loads((folder / DRIVE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise TriformError(f"{folder} cannot be read: {error}") from None
    if len(rows) < 2:
        raise TriformError(f"nothing is kept, because {path} has less than two steps")
    time, *values = (rows[:, columns.index(name)] for name in _KEPT)
    poses, commands = np.stack(values[:3], axis=1), np.stack(values[3:], axis=1)
    known = np.asarray(np.isfinite(poses).all(axis=1))
    poses[~known] = np.nan
    # A full disk ends the steps, and not the drive.
    seen = tuple(each.part(slice(None), slice(len(rows))) for each in senses)
    run = Trajectory(time, poses[None, :, None], known[None, :, None], commands[None, :-1, None], seen)
    setting = RunSetting(config.distance, config.shape, Arena.open(), lidars=(LidarTable.of(config.driven.lidar),))
    writer.add(run, setting, {})
    writer.describe(settings)
