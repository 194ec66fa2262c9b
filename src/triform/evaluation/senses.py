"""What robots sensed in runs: scans, odometry and exploration noise, recorded with the poses where asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from triform.mixed import MixedView
from triform.types import BoolArray, FloatArray, IntArray, RangeArray, Scan, ScanConfig, View

#: Columns of a robot that is not there, by attribute.
_ABSENT = {"ranges": np.inf, "intensities": 0.0, "active": False, "noise": np.nan, "odometry": np.nan}


@dataclass(frozen=True)
class Senses:
    """What the controller of the robots of one kind saw in B runs, once per record.

    Attributes:
        scan: Angles and limits of their scans.
        active: Which of them exist, shape (B, T, N).
        ranges: Newest finished scans [m], float32, shape (B, T, N, R); REP 117 for what is no range.
        intensities: How bright every return is, float32, of the same shape; ``None`` where the LiDAR does not say.
        noise: As ``View.noise``, shape (B, T, N, 2); ``NaN`` where there is none.
        odometry: As ``View.odometry``, shape (B, T, N, 3); ``NaN`` where there is none.
    """

    scan: ScanConfig
    active: BoolArray
    ranges: RangeArray
    intensities: RangeArray | None
    noise: FloatArray
    odometry: FloatArray

    @property
    def robots(self) -> int:
        """How many robots of this kind there are, N."""
        return int(self.active.shape[2])

    def view(self, record: int, time: float, run: int = 0) -> View:
        """Return what the controller saw at a record of a run, B = 1.

        Args:
            record: The record.
            time: Its time [s].
            run: The run.
        """
        here = (slice(run, run + 1), record)
        active = self.active[here]
        bright = None if self.intensities is None else self.intensities[here]
        known = {
            name: np.where(active[..., None], values, 0.0)
            for name, values in (("noise", self.noise[here]), ("odometry", self.odometry[here]))
            if np.isfinite(values[active]).all()
        }
        return View(Scan(np.ascontiguousarray(self.ranges[here]), self.scan, bright), active, time, **known)

    def part(self, runs: slice, records: slice | IntArray) -> Senses:
        """Return some records of some runs."""
        return self._changed(lambda name, values: values[runs, records])  # noqa: ARG005

    def joined(self, others: Sequence[Senses], axis: int) -> Senses:
        """Return this and others one behind the other: runs on axis 0, records on axis 1, robots on axis 2.

        Where runs or records follow each other, those with fewer robots are filled up with absent ones.
        """
        most = max(each.robots for each in (self, *others))
        wide = [each if axis == 2 else each._widened(most) for each in (self, *others)]
        return wide[0]._changed(lambda name, _: np.concatenate([getattr(each, name) for each in wide], axis=axis))

    def _widened(self, robots: int) -> Senses:
        def widen(name: str, values: Any) -> Any:
            widths = [(0, 0)] * values.ndim
            widths[2] = (0, robots - self.robots)
            return np.pad(values, widths, constant_values=_ABSENT[name])

        return self if robots == self.robots else self._changed(widen)

    def _changed(self, change: Callable[[str, Any], Any]) -> Senses:
        """Return this with all arrays changed, each by its name."""
        changed: dict[str, Any] = {}
        for name in _ABSENT:
            values = getattr(self, name)
            changed[name] = None if values is None else change(name, values)
        return replace(self, **changed)


class SensesLog:
    """Collects what robots sense, record by record."""

    def __init__(self) -> None:
        """Begin without a record."""
        self._records: list[list[dict[str, Any]]] = []
        self._scans: list[ScanConfig] = []

    def add(self, view: View) -> None:
        """Take a copy of what was sensed at a record."""
        parts = view.parts if isinstance(view, MixedView) else (view,)
        self._scans = [part.scans.config for part in parts]
        self._records.append([_copied(part) for part in parts])

    @property
    def senses(self) -> tuple[Senses, ...]:
        """What the robots of each kind sensed, in the order of the robots."""
        found = []
        for scan, records in zip(self._scans, zip(*self._records, strict=True), strict=True):
            arrays: dict[str, Any] = {}
            for name in _ABSENT:
                values = [each[name] for each in records]
                if name == "intensities" and any(each is not None for each in values):
                    # Before the first scan there are none.
                    values = [np.zeros_like(records[0]["ranges"]) if each is None else each for each in values]
                arrays[name] = None if values[0] is None else np.stack(values, axis=1)
            found.append(Senses(scan, **arrays))
        return tuple(found)


def _copied(view: View) -> dict[str, Any]:
    """Return copies of what a view shows; of absent robots, what ``_ABSENT`` says."""
    active, bright = np.array(view.active), view.scans.intensities

    def known(values: FloatArray | None, columns: int) -> FloatArray:
        if values is None:
            return np.full((*active.shape, columns), np.nan)
        return np.where(active[..., None], values, np.nan)

    return {
        "active": active,
        "ranges": np.array(view.scans.ranges, np.float32),
        "intensities": None if bright is None else np.array(bright, np.float32),
        "noise": known(view.noise, 2),
        "odometry": known(view.odometry, 3),
    }
