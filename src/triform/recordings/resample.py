"""Recorded runs as trajectories: gaps filled, moments evened out, comings and goings told from gaps."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from triform.evaluation.metrics import WINDOW, RunTable
from triform.evaluation.rollout import Trajectory
from triform.files import refuse_device
from triform.geometry import wrap_angle
from triform.recordings.description import RunSetting
from triform.recordings.formats import RawRun, Track, natural, read_array, read_csv, read_parquet, wide_run
from triform.recordings.kept import KeptRuns, open_runs
from triform.recordings.motive import SIGNATURE, read_motive
from triform.types import FloatArray, TriformError

#: A robot that is not seen for so long [s] is somewhere between where it was and where it will be.
LONGEST_GAP = 0.5
#: Records that are closer together [s] than those of any camera come in bursts, and are evened out at this period [s].
_SHORTEST_PERIOD, _BURST_PERIOD = 0.001, 0.1
#: What is closer than this share of a period is the same moment.
_SAME_MOMENT = 0.01
#: No robot is so fast [m/s]; speeds are taken over so long [s], and by this share of them.
_FASTEST, _SPEED_TIME, _SPEED_SHARE = 10.0, 0.1, 0.9


@dataclass(frozen=True)
class Recording:
    """One recorded run.

    Attributes:
        label: Which run of which file it is.
        robots: Names of the robots, in the order of the trajectory.
        trajectory: The run, B = 1, evenly spaced; its commands are ``NaN`` where they are not known.
        changes: Sentences that say which robots come and go.
        setting: Its setting, where the file has it.
        whole: Measures of the whole run, one row, which the records alone cannot give.
    """

    label: str
    robots: tuple[str, ...]
    trajectory: Trajectory
    changes: tuple[str, ...]
    setting: RunSetting | None = None
    whole: RunTable = field(default_factory=dict)


def read_recordings(
    path: Path, rate: float | None = None, start: float = 0.0, end: float | None = None, scans: int = 0
) -> list[Recording]:
    """Read all runs of a file; those that a simulation kept, and that are not cut, just as they were.

    Args:
        path: Poses in ``.csv``, ``.parquet``, ``.npy`` or ``.mcap``, a Motive export in ``.csv``, or the folder of a
            ROS 2 bag.
        rate: Records per second of an ``.npy`` file [Hz].
        start: What comes earlier after the first record of a run is left out [s].
        end: What comes later is left out [s]; nothing by default.
        scans: Of how many runs that are read just as they were to read what their robots sensed, where it is kept.

    Returns:
        The runs by growing number.

    Raises:
        TriformError: The file cannot be read, or a run cannot be measured; one sentence says why and where.
    """
    try:
        refuse_device(path)
        kept = _open_kept(path)
        if kept is not None:
            return _read_kept(kept, start, end, scans)
        raw = _read(path, rate)
    except (OSError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise TriformError(f"{path} cannot be read: {reason.lower()}") from None
    recordings = [even_out(run, start, end) for run in raw]
    if not recordings:
        raise TriformError(f"{path} holds no poses")
    return recordings


def _open_kept(path: Path) -> KeptRuns | None:
    """Open a file of kept runs; ``None`` if it is another one."""
    if path.is_dir():
        return None
    if path.suffix == ".mcap":
        from triform.recordings.mcap import open_mcap_runs

        return open_mcap_runs(path)
    return open_runs(path) if path.suffix == ".parquet" else None


def _read_kept(kept: KeptRuns, start: float, end: float | None, scans: int) -> list[Recording]:
    """Read kept runs: exactly, or evened out if they are cut or a robot's odometry."""
    found = []
    exact = kept.description.source == "simulation" and start == 0 and end is None
    for number, entry in enumerate(kept.description.runs):
        label, setting = kept.label(number), kept.setting(number)
        trajectory = kept.trajectory(number, scans=exact and number < scans)
        names = [str(robot) for robot in range(entry.robots)]
        if exact:
            found.append(Recording(label, tuple(names), trajectory, (), setting, entry.measures))
            continue
        cut = even_out(wide_run(label, trajectory.time, names, trajectory.poses[0]), start, end)
        found.append(replace(cut, setting=setting.of_robots([int(name) for name in cut.robots])))
    return found


def _read(path: Path, rate: float | None) -> list[RawRun]:
    if path.is_dir():
        from triform.recordings.bags import read_bag

        return read_bag(path)
    if path.suffix == ".npy":
        return read_array(path, rate)
    if path.suffix == ".parquet":
        return read_parquet(path)
    if path.suffix == ".mcap":
        from triform.recordings.mcap import read_mcap

        return read_mcap(path)
    if path.suffix != ".csv":
        raise TriformError(
            f"{path} ends in {path.suffix!r}; recordings are read from .csv, .parquet, .npy, .mcap or ROS 2 bags"
        )
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        is_motive = file.read(len(SIGNATURE)) == SIGNATURE
    return read_motive(path) if is_motive else read_csv(path)


def even_out(run: RawRun, start: float = 0.0, end: float | None = None) -> Recording:
    """Return the poses of a run at evenly spaced moments.

    The period is the median one of the records; where records are evenly spaced already, they stay as they are.
    Between records positions move on straight lines, and headings the shortest way round. A robot exists from its first
    record to its last one. The run begins when all robots are there whose first record is within 0.5 s of
    the very first, and ends likewise.

    Args:
        run: The tracks as they were recorded.
        start: What comes earlier after the first record is left out [s].
        end: What comes later is left out [s]; nothing by default.

    Raises:
        TriformError: A robot is not seen for more than 0.5 s and then again, less than 5 s are left, there are
            never two robots at a time, or positions, headings and times cannot be in metres, radians and seconds.
    """
    whole = {name: run.tracks[name] for name in sorted(run.tracks, key=natural) if len(run.tracks[name].time)}
    if not whole:
        raise TriformError(f"{run.label} holds no poses")
    zero = min(float(track.time[0]) for track in whole.values())
    _refuse_degrees(run.label, whole)
    tracks = _cut(whole, zero + start, np.inf if end is None else zero + end)
    for name, track in tracks.items():
        _refuse_gaps(f"{run.label}: robot {name}", track.time, zero)
    period = _period(run.label, tracks)
    margin = _SAME_MOMENT * period
    firsts = np.array([track.time[0] for track in tracks.values()])
    lasts = np.array([track.time[-1] for track in tracks.values()])
    begin = float(firsts[firsts <= firsts.min() + LONGEST_GAP].max())
    finish = float(lasts[lasts >= lasts.max() - LONGEST_GAP].min())
    if finish - begin < WINDOW - margin:
        raise TriformError(
            f"{run.label} lasts {max(0.0, finish - begin):.3g} s; a run is measured over its last {WINDOW:g} s, "
            "so it must last at least that long"
        )
    time = np.linspace(0.0, finish - begin, round((finish - begin) / period) + 1)
    tracks = {
        name: track
        for name, track in tracks.items()
        if track.time[0] <= finish + margin and track.time[-1] >= begin - margin
    }
    poses = np.stack([_interpolated(track, begin + time, margin) for track in tracks.values()], axis=1)
    active = np.isfinite(poses[..., 0])
    if active.sum(axis=1).max() < 2:
        raise TriformError(f"{run.label} has never two robots at a time; a formation has at least two")
    _refuse_speed(run.label, tuple(tracks), poses, period)
    unknown = np.broadcast_to(np.nan, (1, len(time) - 1, len(tracks), 3))
    changes = _changes(run.label, tracks, begin, finish, margin)
    return Recording(run.label, tuple(tracks), Trajectory(time, poses[None], active[None], unknown), changes)


def _cut(tracks: dict[str, Track], low: float, high: float) -> dict[str, Track]:
    """Return what was seen from ``low`` to ``high`` [s], without the robots that were not."""
    cut = {}
    for name, track in tracks.items():
        first, last = np.searchsorted(track.time, [low - 1e-6, high + 1e-6])
        if last > first:
            cut[name] = Track(track.time[first:last], track.poses[first:last])
    return cut


def _period(label: str, tracks: dict[str, Track]) -> float:
    """Return the time between two of the even moments [s]."""
    if not any(len(track.time) > 1 for track in tracks.values()):
        raise TriformError(f"{label} has no two records of a robot to measure")
    periods = np.concatenate([np.diff(track.time) for track in tracks.values()])
    ratios = periods / np.median(periods)
    # Times are rounded, so the median alone would gain or lose records over a long run.
    period = float(periods[(ratios > 0.5) & (ratios < 1.5)].mean())
    return period if period >= _SHORTEST_PERIOD else _BURST_PERIOD


def _refuse_degrees(label: str, tracks: dict[str, Track]) -> None:
    """Refuse headings that begin beyond a turn in most tracks: counted in radians they begin within one."""
    first = np.array([abs(track.poses[0, 2]) for track in tracks.values()])
    if np.median(first) > 2 * np.pi:
        raise TriformError(
            f"{label} has headings such as {first.max():.4g}; they look like degrees, radians are needed"
        )


def _refuse_speed(label: str, robots: tuple[str, ...], poses: FloatArray, period: float) -> None:
    """Refuse robots that are faster, by positions and times, than any robot; poses of shape (T, N, 3)."""
    lag = max(1, round(_SPEED_TIME / period))
    speeds = np.linalg.norm(poses[lag:, :, :2] - poses[:-lag, :, :2], axis=2) / (lag * period)
    for name, own in zip(robots, speeds.T, strict=True):
        usual = np.quantile(own[np.isfinite(own)], _SPEED_SHARE) if np.isfinite(own).any() else 0.0
        if usual > _FASTEST:
            raise TriformError(
                f"{label}: robot {name} moves at {usual:.3g} m/s by its positions and times; metres and seconds are "
                "needed"
            )


def _changes(label: str, tracks: dict[str, Track], begin: float, finish: float, margin: float) -> tuple[str, ...]:
    """Say which robots come after ``begin`` and go before ``finish`` [s]; times that are said count from ``begin``."""
    changes = []
    for name, track in tracks.items():
        if track.time[0] > begin + margin:
            changes.append(f"{label}: robot {name} comes at {track.time[0] - begin:.2f} s")
        if track.time[-1] < finish - margin:
            changes.append(f"{label}: robot {name} goes at {track.time[-1] - begin:.2f} s")
    return tuple(changes)


def _refuse_gaps(where: str, time: FloatArray, zero: float) -> None:
    """Refuse a robot that is not seen for too long; times in the message count from ``zero`` [s]."""
    gaps = np.diff(time) > LONGEST_GAP + 1e-6
    if gaps.any():
        first = int(np.argmax(gaps))
        raise TriformError(
            f"{where} has no record from {time[first] - zero:.2f} s to {time[first + 1] - zero:.2f} s; "
            f"gaps of at most {LONGEST_GAP:g} s are filled, so cut the run with start and end"
        )


def _interpolated(track: Track, time: FloatArray, margin: float) -> FloatArray:
    """Return the poses of a robot at given moments, shape (T, 3); ``NaN`` before and after its track."""
    headings = np.unwrap(track.poses[:, 2])
    columns = [np.interp(time, track.time, values) for values in (*track.poses[:, :2].T, headings)]
    poses = np.stack([*columns[:2], wrap_angle(columns[2])], axis=1)
    poses[(time < track.time[0] - margin) | (time > track.time[-1] + margin)] = np.nan
    return poses
