"""What robots sensed in the last step and what was made of it, so that a team at rest costs next to nothing.

A controller that is a function of a robot's scan and a few numbers beside it has its answer already if none of them has
changed to the bit. Scans of real LiDARs always change; simulated ones without noise stay the same at rest.
"""

from __future__ import annotations

import threading

import numpy as np

from triform.kernels import kernel
from triform.types import BoolArray, FloatArray, Scan


@kernel
def _note_changes(ranges, beside, active, last_ranges, last_beside, known, changed):
    """Find the robots that sense something else than in the last step, and note what they sense now.

    Args:
        ranges: Ranges [m], shape (M, R).
        beside: What else an answer depends on, shape (M, K).
        active: Robots that exist, shape (M,).
        last_ranges: Of the last step, to change, shape (M, R).
        last_beside: Of the last step, to change, shape (M, K).
        known: Robots of which there is an answer, to change, shape (M,).
        changed: Robots that exist and sense something else than then, to fill, shape (M,).
    """
    for m in range(ranges.shape[0]):
        changed[m] = False
        if not active[m]:
            continue
        same = known[m]
        for k in range(beside.shape[1]):
            same = same and beside[m, k] == last_beside[m, k]
        for k in range(ranges.shape[1]):
            if not same:
                break
            # What is not a number is never the same.
            same = ranges[m, k] == last_ranges[m, k]
        if not same:
            last_ranges[m], last_beside[m] = ranges[m], beside[m]
            known[m], changed[m] = False, True


class LastStep(threading.local):
    """The last step of M robots, one for each thread; of other robots or another LiDAR, there is none."""

    def __init__(self) -> None:
        self._of: tuple[object, ...] = ()

    def __reduce__(self) -> tuple[type[LastStep], tuple[()]]:
        """Return a new one: a controller that travels remembers nothing."""
        return LastStep, ()

    def compare(self, scans: Scan, beside: FloatArray, active: BoolArray, width: int) -> tuple[BoolArray, FloatArray]:
        """Compare a step with the last one, which it becomes.

        Args:
            scans: Scans of M robots.
            beside: What else an answer depends on, shape (M, K).
            active: Robots that exist, shape (M,).
            width: Numbers of an answer.

        Returns:
            (robots that need a new answer, shape (M,); the answers of the others, shape (M, width), into which the
            caller writes the new ones before it calls ``keep``).
        """
        ranges = scans.ranges.reshape(-1, scans.config.rays)
        of = (scans.config, ranges.dtype, ranges.shape, beside.shape, width)
        if self._of != of:
            self._of = of
            self._ranges, self._beside = np.empty_like(ranges), np.empty_like(beside)
            self._known, self._answers = np.zeros(len(ranges), dtype=np.bool_), np.zeros((len(ranges), width))
        self._changed = np.empty(len(ranges), dtype=np.bool_)
        _note_changes(ranges, beside, active, self._ranges, self._beside, self._known, self._changed)
        return self._changed, self._answers

    def keep(self) -> None:
        """Note that the new answers are there; without it they are asked for again."""
        self._known |= self._changed


def robot_rows(values: FloatArray | None, robots: int, width: int) -> FloatArray:
    """Values of all robots of all worlds, shape (M, width), contiguous; zeros where the view has none."""
    return np.zeros((robots, width)) if values is None else np.ascontiguousarray(values).reshape(-1, width)
