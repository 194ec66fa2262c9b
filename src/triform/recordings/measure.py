"""Recorded runs, measured and drawn: the work of ``triform measure``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from triform.evaluation.metrics import RunTable, concatenate, measure
from triform.evaluation.rollout import Trajectory
from triform.limits import check_threads
from triform.recordings.resample import Recording, read_recordings
from triform.report.listener import SILENT, Listener
from triform.report.output import prepare_folder
from triform.report.results import Evaluation, ResultFiles, show_results
from triform.simulation import Arena, Footprint
from triform.simulation.ray_kernels import Scene
from triform.simulation.world_kernels import Contacts, record_contacts
from triform.threads import limit_threads
from triform.types import TriformError, convert_fields, require
from triform.version import __version__

#: Robots are not farther from their neighbours, or closer to them, than the prescribed distance by this factor.
_SCALE = 30.0


@dataclass(frozen=True)
class MeasureConfig:
    """A measurement of recorded runs.

    Attributes:
        files: Recorded runs: .csv or .parquet with columns time, robot, x, y, heading, .npy, or a Motive export in
            .csv.
        distance: Prescribed neighbour distance d* [m].
        footprint: Outline of the robots: a name such as ep, circle:0.30 (diameter) or box:0.41x0.24 [m].
        rate: Records per second of recordings in .npy [Hz].
        start: Leave out what comes earlier after the first record of a run [s].
        end: Leave out what comes later after the first record of a run [s].
        json: File for the summary.
        parquet: File for one row per run; by default beside the summary.
        figures: Folder for Fig. 7, 8 and 9.
        threads: Threads of the whole command; one for each processor if omitted.
    """

    files: tuple[Path, ...]
    distance: float = 1.0
    footprint: str = "ep"
    rate: float | None = None
    start: float = 0.0
    end: float | None = None
    json: Path | None = None
    parquet: Path | None = None
    figures: Path | None = None
    threads: int | None = None

    def __post_init__(self) -> None:
        convert_fields(self)
        require(len(self.files) > 0, "no file is named; name the recorded runs to measure")
        require(0 < self.distance < np.inf, f"distance is {self.distance} m; it must be positive and finite")
        arrays = any(path.suffix == ".npy" for path in self.files)
        require(
            (self.rate is not None) == arrays,
            "rate is missing; recordings in .npy do not say how many records per second they hold"
            if arrays
            else f"rate is {self.rate} Hz; it is only for recordings in .npy, the others hold their times",
        )
        require(self.rate is None or 0 < self.rate < np.inf, f"rate is {self.rate} Hz; it must be positive and finite")
        require(0 <= self.start < np.inf, f"start is {self.start} s; it must be finite and not negative")
        require(self.end is None or self.end > self.start, f"end is {self.end} s; it must be later than start")
        check_threads(self.threads)
        _ = self.outline

    @property
    def outline(self) -> Footprint:
        """Footprint of the recorded robots."""
        return Footprint.parse(self.footprint)


def run_measure(config: MeasureConfig, listener: Listener = SILENT) -> Evaluation:
    """Measure recorded runs, keep the results in files, draw them and show the table.

    Args:
        config: Which runs, and which files to write.
        listener: Hears of progress, tables and files.

    Returns:
        What was found; one table per team size, which is that at the end of a run. The column ``recording`` says which
        run of which file a row is.

    Raises:
        TriformError: A recording cannot be read or measured, or a result cannot be written.
    """
    files = ResultFiles(config.json, config.parquet)
    if config.figures is not None:
        prepare_folder(config.figures)
    began = time.perf_counter()
    recordings: list[Recording] = []
    tables: list[RunTable] = []
    with limit_threads(config.threads), listener.progress("measuring", len(config.files)) as advance:
        for path in config.files:
            for recording in read_recordings(path, config.rate, config.start, config.end):
                which = {"run": np.array([len(recordings)]), "recording": np.array([recording.label])}
                _refuse_scale(recording, config.distance)
                overlap = np.array([any_overlap(recording.trajectory, config.outline)])
                tables.append(which | measure(recording.trajectory, config.distance, collision=overlap))
                recordings.append(recording)
            advance()
    sizes = sorted({int(table["robots"][0]) for table in tables})
    grouped = [concatenate([table for table in tables if table["robots"][0] == size]) for size in sizes]
    evaluation = Evaluation(describe_recordings(config, recordings), grouped, time.perf_counter() - began)
    for sentence in [each for recording in recordings for each in recording.changes]:
        listener.say(sentence)
    show_results(evaluation, "recorded", listener)
    files.write(evaluation)
    written = files.paths
    if config.figures is not None:
        from triform.figures.recorded import draw_recorded

        with listener.progress("drawing", 1):
            trajectories = [recording.trajectory for recording in recordings]
            written += draw_recorded(trajectories, evaluation.runs, config.outline, config.distance, config.figures)
    for path in written:
        listener.say(f"wrote {path}")
    return evaluation


def _refuse_scale(recording: Recording, distance: float) -> None:
    """Refuse positions that cannot be in metres: at the end, robots are far from their prescribed distance [m]."""
    last = recording.trajectory.poses[0, -1, :, :2][recording.trajectory.active[0, -1]]
    apart = np.linalg.norm(last[:, None] - last, axis=2) + np.where(np.eye(len(last)), np.inf, 0.0)
    nearest = float(np.median(apart.min(axis=1))) if len(last) > 1 else distance
    if not distance / _SCALE < nearest < distance * _SCALE:
        raise TriformError(
            f"{recording.label}: at the end robots are {nearest:.4g} m from their nearest one, and distance is "
            f"{distance:g} m; positions and distance in metres are needed"
        )


def any_overlap(trajectory: Trajectory, footprint: Footprint) -> bool:
    """Tell whether two footprints overlap at any record of a single run; touching is no overlap."""
    poses, active = np.ascontiguousarray(trajectory.poses[0]), np.ascontiguousarray(trajectory.active[0])
    records, arena = len(poses), Arena.open()
    contacts = Contacts(np.full(records, np.inf), *np.zeros((2, records), dtype=np.bool_))
    # Every record is a world of its own to the kernel.
    record_contacts(poses, active, Scene(footprint.body, arena.walls, arena.pillars), contacts, 0, records)
    return bool(contacts.collided.any())


def describe_recordings(config: MeasureConfig, recordings: Sequence[Recording]) -> dict[str, Any]:
    """Return what was measured as plain JSON values."""
    return {
        "controller": "recorded",
        "distance": config.distance,
        "rate": config.rate,
        "start": config.start,
        "end": config.end,
        "footprint": asdict(config.outline),
        "recordings": [
            {
                "recording": each.label,
                "robots": each.robots,
                "duration": float(each.trajectory.time[-1]),
                "period": each.trajectory.period,
                "changes": each.changes,
            }
            for each in recordings
        ],
        "triform": __version__,
    }
