"""From packets to turns: scans on a fixed grid of rays, with times of the host's clock.

A LiDAR turns clockwise, or counter-clockwise if it hangs upside down; its turns differ in length, and packets get lost.
Here, and nowhere else, its samples become rays that count counter-clockwise from ``angle_min`` and are equally many in
every turn: what follows needs that.

A turn ends where the LiDAR passes the gap between the last ray and the first, which by default is behind the robot.

**Rays.** Each ray takes the sample nearest in angle: that is what a simulated ray shows, and no obstacle grows. Of
samples that are equally near the nearer range counts. A ray with no sample within ``REACH`` spacings has no
measurement (NaN).

**Times.** The LiDAR stamps packets with a clock of its own, and packets reach the host late by a changing amount, many
at once, but never early. So the smallest difference of both clocks seen lately is that of packets that were not held
up. It may rise by ``DRIFT``, as two quartzes drift apart. A sample's time is that on the LiDAR's clock plus this
difference.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triform.kernels import kernel
from triform.robots.laser_scan import Turn
from triform.robots.ldrobot.models import LidarModel
from triform.robots.ldrobot.packets import CLOCK_WRAP, LINE_RATE, PACKET_BYTES, SAMPLES, Packets, sample_angles
from triform.simulation.mounting import Mounting
from triform.types import FloatArray, IntArray, ScanConfig

#: How far a ray looks for its sample [spacings of rays or of samples, whichever is wider]. Half a spacing is the least
#: at the usual speed; this also bridges the wider spacing of a LiDAR that turns half as fast again.
REACH = 0.75
#: Smallest share of its rays that makes a turn worth handing on.
LEAST_MEASURED = 0.5
#: After a pause of the LiDAR, or an error of its clock, longer than this [s] everything begins anew.
LONGEST_GAP = 1.0
#: How fast the clocks of host and LiDAR may drift apart [s/s].
DRIFT = 5e-4
#: Time from the last sample of a packet to its arrival, if nothing holds it up [s].
_WIRE_TIME = PACKET_BYTES / LINE_RATE


@kernel
def _enter_into(places: Any, ranges: Any, intensities: Any, reach: float, apart: Any, row: Any, levels: Any) -> None:
    """Enter samples at ``places`` [spacings after the gap] into the rays ``row`` that they are nearest to.

    Rays are in the order in which the LiDAR passes them; ``apart`` holds how far from each ray the sample is that it
    has [spacings], and ``levels`` gets its intensity.
    """
    rays = row.shape[0]
    for k in range(places.shape[0]):
        centre = places[k] - 0.5
        for ray in range(math.ceil(centre - reach), math.floor(centre + reach) + 1):
            distance = abs(centre - ray)
            slot = ray % rays
            if distance < apart[slot] or (distance == apart[slot] and ranges[k] < row[slot]):
                apart[slot] = distance
                row[slot] = ranges[k]
                levels[slot] = intensities[k]


class TurnAssembler:
    """Collects packets until a turn is complete; the one in which it begins, which lacks a part, is dropped."""

    def __init__(self, model: LidarModel, scan: ScanConfig | None = None, mounting: Mounting | None = None) -> None:
        """Begin with no packet.

        Args:
            model: The LiDAR.
            scan: Rays and limits of range; those of the model if ``None``.
            mounting: How the LiDAR is mounted; upright, its zero forward, if ``None``. Rays have the directions of the
                base's frame and begin at the LiDAR.
        """
        mounting = mounting or Mounting()
        self.scan = model.scan_config() if scan is None else scan
        rays = self.scan.rays
        self._reach = REACH * max(1.0, rays / model.rays)
        # Upright it turns clockwise, and the rays are entered from the last to the first.
        self._entered = -mounting.direction
        self._zero = -self._entered * (self.scan.angle_min - mounting.yaw) / self.scan.angle_increment
        self._zero += 0.5 * self._entered
        self._rays_per_degree = rays / 360
        self._lags = np.arange(SAMPLES)[::-1] / model.samples_per_second
        self._row, self._levels = np.empty(rays, dtype=np.float32), np.empty(rays, dtype=np.float32)
        self._apart = np.empty(rays)
        self._stamp, self._clock, self._offset = 0, 0.0, math.nan
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._place, self._time = math.nan, math.nan
        self._begin_turn(whole=False)

    def _begin_turn(self, whole: bool) -> None:
        self._row.fill(np.nan)
        self._levels.fill(0.0)
        self._apart.fill(np.inf)
        self._first, self._last = math.inf, math.inf
        self._whole = whole

    def add(self, packets: Packets, arrival: float) -> list[Turn]:
        """Take the next packets and return the turns that they complete, oldest first.

        Args:
            packets: Packets in the order in which they were sent, shape (K,).
            arrival: When the last of them had arrived, on the host's monotonic clock [s].
        """
        if not len(packets):
            return []
        stamps: IntArray = packets["timestamp"].astype(np.int64)
        steps: IntArray = np.diff(stamps, prepend=self._stamp) % CLOCK_WRAP
        gaps = np.flatnonzero(steps > 1000 * LONGEST_GAP)
        if len(gaps):
            packets, steps = packets[gaps[-1] :], steps[gaps[-1] :]
            self._offset = math.nan
        clock = self._clock + np.cumsum(steps) / 1000
        self._follow(float(clock[-1]), arrival - _WIRE_TIME)
        self._stamp = int(stamps[-1])
        return self._sweep(packets, clock)

    def _follow(self, clock: float, sent: float) -> None:
        """Follow the difference of the clocks: the LiDAR's showed ``clock`` at ``sent`` on the host's, or before."""
        late = sent - clock - self._offset
        if abs(late) <= LONGEST_GAP:
            self._offset += min(late, DRIFT * (clock - self._clock))
        else:
            # It is NaN, and comes here, while there is no difference to follow.
            self._offset = sent - clock
            self._begin_anew()
        self._clock = clock

    def _sweep(self, packets: Packets, clock: FloatArray) -> list[Turn]:
        """Enter samples, turn by turn."""
        rays = self.scan.rays
        places = (sample_angles(packets) * self._rays_per_degree + self._zero) % rays
        times = (clock[:, None] - self._lags).ravel()
        ranges = self._measured(packets["samples"]["distance"].ravel())
        intensities = packets["samples"]["intensity"].ravel()

        place, time = (places[0], times[0]) if math.isnan(self._place) else (self._place, self._time)
        ahead = (np.diff(places, prepend=place) + rays / 2) % rays - rays / 2
        # Where packets are missing, whole turns may be: the speed tells how many.
        speeds = np.repeat(packets["speed"], SAMPLES) * self._rays_per_degree
        ahead += rays * np.rint((np.diff(times, prepend=time) * speeds - ahead) / rays)
        turns = np.rint((place + np.cumsum(ahead) - places) / rays)
        # Who falls back before the gap, by an uneven speed, belongs to no turn any more.
        newest = np.maximum.accumulate(np.maximum(turns, 0))
        self._place = float(places[-1] + rays * (turns[-1] - newest[-1]))
        self._time = float(times[-1])

        finished: list[Turn] = []
        edges = np.flatnonzero(np.diff(newest, prepend=0.0))
        for piece, samples in enumerate(np.split(np.arange(len(places)), edges)):
            if piece:
                finished += self._finish()
            kept = samples[turns[samples] == newest[samples]]
            if len(kept):
                samples_kept = places[kept], ranges[kept], intensities[kept]
                _enter_into(*samples_kept, self._reach, self._apart, self._row, self._levels)
                self._first = min(self._first, float(times[kept[0]]))
                self._last = float(times[kept[-1]])
        return finished

    def _finish(self) -> list[Turn]:
        """End a turn; return it if it is worth it."""
        turn = Turn(
            self._row[:: self._entered].copy(),
            self._first + self._offset,
            self._last + self._offset,
            self._levels[:: self._entered].copy(),
        )
        worth = self._whole and (~np.isnan(turn.ranges)).mean() >= LEAST_MEASURED
        self._begin_turn(whole=True)
        return [turn] if worth else []

    def _measured(self, millimetres: NDArray[np.uint16]) -> FloatArray:
        """Return distances as ranges after REP 117 [m]."""
        ranges = millimetres / 1000.0
        ranges[ranges < self.scan.range_min] = -np.inf
        ranges[(ranges > self.scan.range_max) | (millimetres == 0)] = np.inf
        return ranges
