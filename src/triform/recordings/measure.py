"""Recorded runs, measured and drawn: the work of ``triform measure``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from triform.evaluation.metrics import RunTable, concatenate, measure, recovery
from triform.evaluation.rollout import Trajectory
from triform.limits import check_threads
from triform.recordings.description import RunSetting
from triform.recordings.resample import Recording, read_recordings
from triform.report.listener import SILENT, Listener
from triform.report.output import prepare_folder
from triform.report.results import Evaluation, ResultFiles, show_results
from triform.simulation import FOOTPRINTS, Arena, Footprint
from triform.simulation.lidar import make_scene
from triform.simulation.world_kernels import Contacts, record_contacts
from triform.threads import limit_threads
from triform.types import TriformError, convert_fields, require
from triform.version import __version__

#: Prescribed neighbour distance where neither options nor files say it [m].
DISTANCE = 1.0
#: Robots are not farther from their neighbours, or closer to them, than the prescribed distance by this factor.
_SCALE = 30.0


@dataclass(frozen=True)
class MeasureConfig:
    """A measurement of recorded runs.

    Attributes:
        files: Recorded runs: kept ones, .csv or .parquet with columns time, robot, x, y, heading, .npy, a Motive export
            in .csv, .mcap, or folders of ROS 2 bags.
        distance: Prescribed neighbour distance d* [m]; that of the file if omitted, or 1 m where it has none.
        footprint: Outline of the robots: a name such as ep, circle:0.30 (diameter) or box:0.41x0.24 [m]; that of the
            file if omitted, or ep where it has none.
        rate: Records per second of recordings in .npy [Hz].
        start: Leave out what comes earlier after the first record of a run [s].
        end: Leave out what comes later after the first record of a run [s].
        json: File for the summary.
        parquet: File for one row per run; by default beside the summary.
        figures: Folder for Fig. 7, 8 and 9.
        threads: Threads of the whole command; one for each processor if omitted.
    """

    files: tuple[Path, ...]
    distance: float | None = None
    footprint: str | None = None
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
        require(
            self.distance is None or 0 < self.distance < np.inf,
            f"distance is {self.distance} m; it must be positive and finite",
        )
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
    def outline(self) -> Footprint | None:
        """Footprint of the recorded robots; ``None`` if their files say it."""
        return None if self.footprint is None else Footprint.parse(self.footprint)

    def setting(self, recording: Recording) -> RunSetting:
        """Return the setting of a run: what is given, else what its file has."""
        known = recording.setting or RunSetting(DISTANCE, FOOTPRINTS["ep"], Arena.open())
        distance = known.distance if self.distance is None else self.distance
        return replace(known, distance=distance, footprint=self.outline or known.footprint)


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
    found: list[dict[str, Any]] = []
    drawn: list[tuple[Trajectory, RunSetting]] = []
    changes: list[str] = []
    tables: list[RunTable] = []
    shown = 0
    if config.figures is not None:
        from triform.figures.recorded import SHOWN

        shown = SHOWN
    with limit_threads(config.threads), listener.progress("measuring", len(config.files)) as advance:
        for path in config.files:
            scans = max(0, shown - len(drawn))
            for recording in read_recordings(path, config.rate, config.start, config.end, scans):
                setting = config.setting(recording)
                which = {"run": np.array([len(tables)]), "recording": np.array([recording.label])}
                tables.append(which | measure_recording(recording, setting))
                found.append(_describe(recording, setting))
                changes.extend(recording.changes)
                if config.figures is not None:
                    drawn.append((recording.trajectory, setting))
            advance()
    evaluation = Evaluation(_settings(config, found), _by_size(tables), time.perf_counter() - began)
    for sentence in changes:
        listener.say(sentence)
    show_results(evaluation, "recorded", listener)
    files.write(evaluation)
    written = files.paths
    if config.figures is not None:
        from triform.figures.recorded import draw_recorded
        from triform.figures.runs import Scene

        with listener.progress("drawing", 1):
            trajectories = [trajectory for trajectory, _ in drawn]
            scenes = [Scene(each.footprint, each.arena, each.distance) for _, each in drawn]
            written += draw_recorded(trajectories, scenes, evaluation.runs, config.figures)
    for path in written:
        listener.say(f"wrote {path}")
    return evaluation


def measure_recording(recording: Recording, setting: RunSetting) -> RunTable:
    """Measure a recorded run.

    Of one that a simulation kept the measures are those of the run, to the bit, as long as distance and footprint are
    its own; of the others, contacts and the smallest distance are those of the records.

    Args:
        recording: The run.
        setting: With which d* and footprint to measure it.

    Returns:
        One row.

    Raises:
        TriformError: It is too short, or its positions cannot be in metres.
    """
    run, whole, known = recording.trajectory, recording.whole, recording.setting
    if known is None or known.distance != setting.distance:
        _refuse_scale(recording, setting.distance)
    if known is None or not whole or known.footprint != setting.footprint:
        collided, hit_arena = contacts_of_records(run, setting)
        whole = whole | {"collision": np.array([collided]), "hit_arena": np.array([hit_arena])}
    event = setting.event if "robots_before" in whole else None
    table = measure(
        run if event is None else run.since(event.time),
        setting.distance,
        min_distance=whole.get("min_distance"),
        collision=whole["collision"],
        hit_arena=whole["hit_arena"],
    )
    return table | whole | ({} if event is None else recovery(table, event.time))


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


def contacts_of_records(trajectory: Trajectory, setting: RunSetting) -> tuple[bool, bool]:
    """Tell whether footprints overlap each other, and the arena, at any record of a run; touching is no overlap."""
    poses, active = np.ascontiguousarray(trajectory.poses[0]), np.ascontiguousarray(trajectory.active[0])
    records, robots = active.shape
    contacts = Contacts(np.full(records, np.inf), *np.zeros((2, records), dtype=np.bool_))
    # Every record is a world of its own to the kernel.
    record_contacts(poses, active, make_scene(setting.footprint, setting.arena, robots), contacts, 0, records)
    return bool(contacts.collided.any()), bool(contacts.hit_arena.any())


def _by_size(tables: Sequence[RunTable]) -> list[RunTable]:
    """Return the runs of every team size in one table: the size at the end, or before an event that interrupts.

    Raises:
        TriformError: An event interrupts some of the runs, which have other measures than the rest.
    """
    if any(set(table) != set(tables[0]) for table in tables):
        raise TriformError(
            "an event interrupts some of the runs and not the others, and their measures differ; measure them apart"
        )
    sizes = [int(table.get("robots_before", table["robots"])[0]) for table in tables]
    return [
        concatenate([table for table, own in zip(tables, sizes, strict=True) if own == size])
        for size in sorted(set(sizes))
    ]


def _describe(recording: Recording, setting: RunSetting) -> dict[str, Any]:
    """Return a recorded run as plain JSON values."""
    outline = setting.footprint
    return {
        "recording": recording.label,
        "robots": recording.robots,
        "duration": float(recording.trajectory.time[-1]),
        "period": recording.trajectory.period,
        "distance": setting.distance,
        "footprint": asdict(outline) if isinstance(outline, Footprint) else [asdict(each) for each in outline],
        "changes": recording.changes,
    }


def _settings(config: MeasureConfig, recordings: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return what was measured as plain JSON values; distance and footprint if they are those of all runs."""
    first = recordings[0]
    shared = {
        name: first[name] if all(each[name] == first[name] for each in recordings) else None
        for name in ("distance", "footprint")
    }
    return {
        "controller": "recorded",
        "rate": config.rate,
        "start": config.start,
        "end": config.end,
        **shared,
        "recordings": list(recordings),
        "triform": __version__,
    }
