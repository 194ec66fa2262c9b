"""The measures of one run and their summary over many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triform.evaluation.rollout import Trajectory
from triform.evaluation.statistics import median_interval, wilson_interval
from triform.geometry import assess, edge_error, smallest_distance
from triform.types import SENSING_RANGE, BoolArray, FloatArray, converted, require

#: Errors are averaged over this long [s]; so no run counts as converged before it.
WINDOW = 5.0
#: Whether a formation is strict is looked at this often [s], and at the end.
STRICT_PERIOD = 0.5
#: A formation is right while its mean relative edge error is below this.
TOLERANCE = 0.1

#: One column per measure, one row per run.
RunTable = dict[str, NDArray[Any]]


def trailing_mean(series: FloatArray, time: FloatArray, window: float = WINDOW) -> FloatArray:
    """Mean over the latest ``window`` seconds, at every record.

    The window ending at t holds the records in (t - window, t]: at 10 Hz and 5 s, fifty of them.

    Args:
        series: Values at evenly spaced records, shape (..., T).
        time: Time of the records [s], shape (T,).
        window: Length of the window [s].

    Returns:
        Means, shape (..., T); ``NaN`` as long as less than one window has passed, and where a value is ``NaN``.

    Raises:
        ConfigurationError: The records span less than one window.
    """
    period = (time[-1] - time[0]) / (len(time) - 1) if len(time) > 1 else np.inf
    span = round(window / period)
    require(
        1 <= span < len(time),
        f"the run lasts {time[-1] - time[0]:g} s; it is measured over windows of {window:g} s, "
        "so it must last at least that long",
    )
    windows = np.lib.stride_tricks.sliding_window_view(series[..., 1:], span, axis=-1)
    means = np.full(series.shape, np.nan)
    means[..., span:] = windows.mean(axis=-1)
    return means


def converge_time(series: FloatArray, time: FloatArray, tolerance: float = TOLERANCE) -> FloatArray:
    """First time from which the 5 s mean of the error stays below ``tolerance`` to the end.

    Args:
        series: Relative edge error ``E_g / d*``, shape (..., T).
        time: Time of the records since the start [s], shape (T,).
        tolerance: Largest error of a converged formation, exclusive.

    Returns:
        Times [s], shape (...); never below 5 s after the first record, ``NaN`` for runs that end unconverged.
    """
    below = trailing_mean(series, time) < tolerance
    last_above = below.shape[-1] - 1 - np.argmax(~below[..., ::-1], axis=-1)
    # The first 5 s have no mean and never count as below, so last_above always exists.
    first = np.minimum(last_above + 1, below.shape[-1] - 1)
    return np.where(below[..., -1], time[first], np.nan)


def settle(trajectory: Trajectory, distance: float = 1.0) -> RunTable:
    """Measure since when every run is a triangulation for good, and how still its robots then are.

    Whether a formation is strict is looked at every 0.5 s, counted back from the end. Speeds are those between
    records: the way from one to the next over the time that it took.

    Args:
        trajectory: B runs of at least 5 s.
        distance: Prescribed neighbour distance d* [m].

    Returns:
        ``strict_time``, the first time from which a run is strict whenever looked at to the end [s]; ``strict_hold``,
        the share of the last 5 s in which it is strict; ``settled_speed``, the median over robots and over the records
        of the last 5 s that follow ``strict_time`` [m/s]. Times and speeds are ``NaN`` for runs that do not end
        strict, and the speed is too if a run is strict in its last record only.
    """
    positions, time, last = trajectory.positions, trajectory.time, len(trajectory.time) - 1
    stride = max(1, round(STRICT_PERIOD / trajectory.period))
    looked = np.arange(last % stride, last + 1, stride)
    strict = assess(positions[:, looked], distance, np.inf, trajectory.active[:, looked]).strict
    lasting = np.logical_and.accumulate(strict[:, ::-1], axis=1)[:, ::-1]
    strict_time = np.where(lasting[:, -1], time[looked][np.argmax(lasting, axis=1)], np.nan)
    latest = int(np.searchsorted(time, time[-1] - WINDOW - 1e-6))
    ways = np.linalg.norm(np.diff(positions[:, latest:], axis=1), axis=-1)
    speeds = ways / np.diff(time[latest:])[:, None]
    settled = [time[latest:-1] >= since - 1e-6 for since in strict_time]
    return {
        "strict_time": strict_time,
        "strict_hold": strict[:, time[looked] > time[-1] - WINDOW + 1e-6].mean(axis=1),
        "settled_speed": np.array([quantile(speeds[run, since], 0.5) for run, since in enumerate(settled)]),
    }


def measure(
    trajectory: Trajectory,
    distance: float = 1.0,
    sensing_range: float | None = None,
    min_distance: FloatArray | None = None,
    collision: BoolArray | None = None,
    hit_arena: BoolArray | None = None,
) -> RunTable:
    """Measure every run of a trajectory.

    The graph G is the Gabriel graph of all robots; ``*_sensed`` restricts it to pairs within ``sensing_range``.
    A run whose graph has no edge at some moment of its last 5 s, such as that of a single robot, has a
    ``formation_error`` of ``NaN`` and is no success.

    Args:
        trajectory: B runs of at least 5 s.
        distance: Prescribed neighbour distance d* [m].
        sensing_range: How far a robot senses [m]; 2 d* if omitted.
        min_distance: Smallest distance between two robots [m], shape (B,), where the team keeps watch between
            records; by default the smallest one recorded, infinite where there are not two robots.
        collision: Whether two footprints ever overlapped, shape (B,), where the team knows; no by default.
        hit_arena: Whether a footprint ever overlapped a wall or pillar, shape (B,), where the team knows; no by
            default.

    Returns:
        A table with one row per run.

    Raises:
        ConfigurationError: The trajectory is shorter than 5 s, or ``distance`` is not positive.
    """
    distance = converted("distance", distance, float)
    positions, active, time = trajectory.positions, trajectory.active, trajectory.time
    if sensing_range is None:
        sensing_range = SENSING_RANGE * distance
    full = edge_error(positions, distance, np.inf, active)
    sensed = edge_error(positions, distance, sensing_range, active)
    formation_error = trailing_mean(full, time)[..., -1]
    formation_error_sensed = trailing_mean(sensed, time)[..., -1]
    start = assess(positions[:, 0], distance, sensing_range, active[:, 0])
    end = assess(positions[:, -1], distance, np.inf, active[:, -1])
    end_sensed = assess(positions[:, -1], distance, sensing_range, active[:, -1])
    never = np.zeros(len(positions), dtype=np.bool_)
    return {
        "robots": active[:, -1].sum(axis=-1),
        "formation_error": formation_error,
        "formation_error_sensed": formation_error_sensed,
        "success": formation_error < TOLERANCE,
        "success_sensed": formation_error_sensed < TOLERANCE,
        "converge_time": converge_time(full, time),
        "strict": end.strict,
        "strict_sensed": end_sensed.strict,
        **settle(trajectory, distance),
        "compactness": end.compactness,
        "edges": end.edges,
        "connected_start": start.connected,
        "connected_end": end_sensed.connected,
        "min_distance": closest(trajectory) if min_distance is None else np.array(min_distance),
        "collision": never if collision is None else np.array(collision),
        "hit_arena": never if hit_arena is None else np.array(hit_arena),
    }


def recovery(later: RunTable, event_time: float) -> RunTable:
    """Return how long after an event runs are right for good [s]: ``recovery_time`` and ``strict_recovery_time``.

    Args:
        later: Measures from the event on.
        event_time: When it came [s].
    """
    return {
        "recovery_time": later["converge_time"] - event_time,
        "strict_recovery_time": later["strict_time"] - event_time,
    }


def closest(trajectory: Trajectory) -> FloatArray:
    """Smallest recorded distance between two robots of each run [m], shape (B,); infinite without a pair."""
    recorded = smallest_distance(trajectory.positions, trajectory.active)
    return np.asarray(recorded.min(axis=1, initial=np.inf), dtype=np.float64)


#: Measures of which ``summarise`` gives the rate, with Wilson's interval.
_RATES = ("success", "success_sensed", "strict", "strict_sensed", "connected_end", "collision", "hit_arena")
#: Measures of which ``summarise`` gives the median of the runs that define it, with an interval.
_MEDIANS = ("strict_time", "settled_speed", "formation_error", "converge_time")


def summarise(table: RunTable) -> dict[str, Any]:
    """Summarise runs of one team size: rates and errors as fractions, times in seconds, and 95 % intervals.

    Converge time is summarised over the runs that converged; ``NaN`` stands for what no run defines.

    Args:
        table: What ``measure`` returned.

    Returns:
        ``runs`` and its measures.
    """
    summary: dict[str, Any] = {"runs": len(table["success"])}
    for name in _RATES:
        summary |= summarise_rate(name, table[name])
    for name in _MEDIANS:
        summary |= summarise_median(name, table[name])
    return summary | {
        "strict_hold_mean": _mean(table["strict_hold"]),
        "formation_error_p95": quantile(table["formation_error"], 0.95),
        "compactness_mean": _mean(table["compactness"]),
        "min_distance": float(np.min(table["min_distance"], initial=np.inf)),
    }


def summarise_rate(name: str, happened: NDArray[Any]) -> dict[str, Any]:
    """Return the share of runs in which something happened (B,), and its 95 % interval, by their keys."""
    return {name: _mean(happened), f"{name}_interval": wilson_interval(int(happened.sum()), len(happened))}


def summarise_median(name: str, values: NDArray[Any]) -> dict[str, Any]:
    """Return the median of the values (B,) that are defined, and its 95 % interval, by their keys."""
    return {f"{name}_median": quantile(values, 0.5), f"{name}_median_interval": median_interval(values)}


def select(table: RunTable, rows: BoolArray) -> RunTable:
    """Return the given rows of a table."""
    return {name: column[rows] for name, column in table.items()}


def concatenate(tables: Sequence[RunTable]) -> RunTable:
    """Return the rows of several tables with the same columns, in order."""
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


def _defined(values: NDArray[Any]) -> FloatArray:
    return np.asarray(values[np.isfinite(values)], dtype=np.float64)


def _mean(values: NDArray[Any]) -> float:
    defined = _defined(values)
    return float(defined.mean()) if len(defined) else np.nan


def quantile(values: NDArray[Any], share: float) -> float:
    """Return the quantile ``share`` of the values that are defined; ``NaN`` if none is."""
    defined = _defined(values)
    return float(np.quantile(defined, share)) if len(defined) else np.nan
