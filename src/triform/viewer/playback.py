"""A run that is over, played like a film."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

from triform.evaluation.rollout import Trajectory
from triform.types import require
from triform.viewer.formation import TRAIL, Course, Formation, Picture, between, course_row, earlier_poses
from triform.viewer.session import check_speed

#: Records are shown at most this often [s].
_SHORTEST_STEP = 0.08


class Playback:
    """The first run of a trajectory, paused, wound and replayed; every method may be called from any thread."""

    def __init__(
        self, trajectory: Trajectory, distance: float = 1.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Take a run, at its beginning.

        Args:
            trajectory: The run.
            distance: Prescribed neighbour distance d* [m].
            clock: Tells the time [s].
        """
        stride = max(1, round(_SHORTEST_STEP / trajectory.period))
        records = np.arange(0, len(trajectory.time), stride)
        self.time = trajectory.time[records] - trajectory.time[0]
        self.period = float(self.time[1] - self.time[0])
        self._poses, self._active = trajectory.poses[0, records], trajectory.active[0, records]
        self._formations = [
            Formation.of(float(moment), poses, active, distance)
            for moment, poses, active in zip(self.time, self._poses, self._active, strict=True)
        ]
        self._rows = [course_row(formation) for formation in self._formations]
        self._lock = threading.RLock()
        self._clock = clock
        self._paused, self._speed = False, 1.0
        self._at, self._since = 0.0, clock()

    @property
    def duration(self) -> float:
        """Length of the run [s]."""
        return float(self.time[-1])

    @property
    def now(self) -> float:
        """Moment of the run that is shown [s]."""
        with self._lock:
            gone = 0.0 if self._paused else (self._clock() - self._since) * self._speed
            return min(self._at + gone, self.duration)

    @property
    def paused(self) -> bool:
        """Whether time stands still."""
        return self._paused or self.now >= self.duration

    def pause(self, paused: bool = True) -> None:
        """Let time stand still, or go on; from the beginning if the run is over."""
        with self._lock:
            if not paused and self.now >= self.duration:
                self.seek(0.0)
            self.seek(self.now)
            self._paused = paused

    def step(self) -> None:
        """Let time stand still after one more record."""
        with self._lock:
            self.pause()
            later = np.searchsorted(self.time, self.now + 1e-9, side="right")
            self.seek(float(self.time[min(int(later), len(self.time) - 1)]))

    def reset(self) -> None:
        """Begin anew."""
        self.seek(0.0)

    def seek(self, moment: float) -> None:
        """Go to a moment [s].

        Raises:
            ConfigurationError: The run has no such moment.
        """
        require(0 <= moment <= self.duration, f"time is {moment:g} s; the run lasts from 0 to {self.duration:g} s")
        with self._lock:
            self._at, self._since = moment, self._clock()

    @property
    def speed(self) -> float:
        """How many times faster than real the run is played."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        check_speed(speed)
        with self._lock:
            self.seek(self.now)
            self._speed = speed

    def picture(self) -> Picture:
        """Return what is to be drawn now: robots glide from one record to the next."""
        return self.picture_at(self.now)

    def picture_at(self, moment: float) -> Picture:
        """Return what is to be drawn at a moment [s]."""
        record = int(np.searchsorted(self.time, moment - 1e-9))
        formation, before = self._formations[record], self._formations[max(0, record - 1)]
        share = 1.0 - (self.time[record] - moment) / self.period
        first = max(0, record - round(TRAIL / self.period))
        poses = between(earlier_poses(before, formation), formation.poses, float(np.clip(share, 0.0, 1.0)))
        return Picture(formation, poses, self._poses[first : record + 1, :, :2])

    def course(self) -> Course:
        """Return how the run went up to now."""
        return Course.of(self._rows[: int(np.searchsorted(self.time, self.now + 1e-9, side="right"))])
