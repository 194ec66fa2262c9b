"""Recorded runs, measured and drawn: the work of ``triform evaluate --recording``."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from triform import __version__
from triform.evaluation.metrics import RunTable, concatenate, measure
from triform.evaluation.overrides import get_footprint
from triform.evaluation.rollout import Trajectory
from triform.experiments.evaluate import EvaluateConfig, Evaluation, print_evaluation, run_evaluation
from triform.recordings.resample import Recording, read_recordings
from triform.report.output import prepare_file, prepare_folder, write_json
from triform.report.tables import progress_bar, require_parquet, write_parquet
from triform.simulation import ROBOMASTER_EP, Arena, Footprint
from triform.simulation.ray_kernels import Scene
from triform.simulation.world_kernels import Contacts, record_contacts
from triform.threads import limit_threads
from triform.types import require

#: Options of an evaluation that also say something about recorded runs.
_SHARED = {"distance", "footprint", "json", "parquet", "threads"}


@dataclass(frozen=True)
class RecordedConfig(EvaluateConfig):
    """Settings of an evaluation, of new runs or of recorded ones.

    Attributes:
        recording: Files of recorded runs to measure instead: .csv or .parquet with columns time, robot, x, y, heading,
            .npy, or a Motive export in .csv. Of the other options, only distance, footprint (ep if omitted), json,
            parquet and threads go with them, and those that follow.
        rate: Records per second of recordings in .npy [Hz].
        start: Leave out what comes earlier after the first record of a recorded run [s].
        end: Leave out what comes later after the first record of a recorded run [s].
        figures: Folder for Fig. 7, 8 and 9 of recorded runs.
    """

    recording: tuple[Path, ...] = ()
    rate: float | None = None
    start: float = 0.0
    end: float | None = None
    figures: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.recording:
            for name in ("rate", "start", "end", "figures"):
                require(not self._given(name), f"{name} is only for recorded runs; none are named with recording")
            return
        for each in fields(EvaluateConfig):
            require(
                each.name in _SHARED or not self._given(each.name),
                f"{each.name} does not go with recording: what was recorded has been driven already",
            )
        arrays = any(path.suffix == ".npy" for path in self.recording)
        require(
            (self.rate is not None) == arrays,
            "rate is missing; recordings in .npy do not say how many records per second they hold"
            if arrays
            else f"rate is {self.rate} Hz; it is only for recordings in .npy, the others hold their times",
        )
        require(self.rate is None or 0 < self.rate < np.inf, f"rate is {self.rate} Hz; it must be positive and finite")
        require(0 <= self.start < np.inf, f"start is {self.start} s; it must be finite and not negative")
        require(self.end is None or self.end > self.start, f"end is {self.end} s; it must be later than start")

    @property
    def outline(self) -> Footprint:
        """Footprint of the recorded robots."""
        return ROBOMASTER_EP if self.footprint is None else get_footprint(self.footprint)

    def _given(self, name: str) -> bool:
        """Whether a setting is not its default."""
        default = next(each.default for each in fields(self) if each.name == name)
        return bool(getattr(self, name) != default)


def run_evaluate(config: RecordedConfig, console: Console) -> Evaluation:
    """Measure recorded runs if any are named, else drive new ones; the arguments are those of ``run_evaluation``."""
    if config.recording:
        return run_recorded(config, console)
    return run_evaluation(
        EvaluateConfig(**{each.name: getattr(config, each.name) for each in fields(EvaluateConfig)}), console
    )


def run_recorded(config: RecordedConfig, console: Console) -> Evaluation:
    """Measure recorded runs, keep the results in files, draw them and print the table.

    Args:
        config: Which runs, and which files to write.
        console: Where to show table and progress.

    Returns:
        What was found; one table per team size, which is that at the end of a run. The column ``recording`` says which
        run of which file a row is.

    Raises:
        TriformError: A recording cannot be read or measured, or a result cannot be written.
    """
    per_run_file = config.per_run_file
    for path in (config.json, per_run_file):
        if path is not None:
            prepare_file(path)
    if config.figures is not None:
        prepare_folder(config.figures)
    if per_run_file is not None:
        require_parquet()
    began = time.perf_counter()
    outline = config.outline
    recordings: list[Recording] = []
    tables: list[RunTable] = []
    with limit_threads(config.threads), progress_bar(console, "measuring", len(config.recording)) as advance:
        for path in config.recording:
            for recording in read_recordings(path, config.rate, config.start, config.end):
                which = {"run": np.array([len(recordings)]), "recording": np.array([recording.label])}
                overlap = np.array([any_overlap(recording.trajectory, outline)])
                tables.append(which | measure(recording.trajectory, config.distance, collision=overlap))
                recordings.append(recording)
            advance()
    sizes = sorted({int(table["robots"][0]) for table in tables})
    grouped = [concatenate([table for table in tables if table["robots"][0] == size]) for size in sizes]
    evaluation = Evaluation(describe_recorded(config, recordings), grouped, time.perf_counter() - began)
    for sentence in [each for recording in recordings for each in recording.changes]:
        console.print(sentence, markup=False, soft_wrap=True)
    print_evaluation(evaluation, console)
    written: list[Path] = []
    if config.json is not None:
        written.append(write_json(config.json, evaluation.as_json()))
    if per_run_file is not None:
        written.append(write_parquet(per_run_file, evaluation.runs))
    if config.figures is not None:
        from triform.figures.recorded import draw_recorded

        with console.status("drawing"):
            trajectories = [recording.trajectory for recording in recordings]
            written += draw_recorded(trajectories, evaluation.runs, outline, config.distance, config.figures)
    for path in written:
        console.print(f"wrote {path}", soft_wrap=True)
    return evaluation


def any_overlap(trajectory: Trajectory, footprint: Footprint) -> bool:
    """Tell whether two footprints overlap at any record of a single run; touching is no overlap."""
    poses, active = np.ascontiguousarray(trajectory.poses[0]), np.ascontiguousarray(trajectory.active[0])
    records, arena = len(poses), Arena.open()
    contacts = Contacts(np.full(records, np.inf), *np.zeros((2, records), dtype=np.bool_))
    # Every record is a world of its own to the kernel.
    record_contacts(poses, active, Scene(footprint.body, arena.walls, arena.pillars), contacts, 0, records)
    return bool(contacts.collided.any())


def describe_recorded(config: RecordedConfig, recordings: list[Recording]) -> dict[str, Any]:
    """Return what was measured as plain JSON values, in the form of ``describe``."""
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
