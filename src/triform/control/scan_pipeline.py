"""The controller that a practitioner would write from one scan, without learning.

Scan -> centres of the neighbours (``detection``) -> Gabriel graph -> Eq. 8. It sees exactly what the learned policy
sees, but is told the footprint of the robots.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from triform.control.detection import (
    ROBOMASTER_EP_SIZE,
    SCANS_PER_THREAD,
    detect_into,
    kernel_footprint,
    most_robots,
    ray_directions,
)
from triform.geometry.gabriel import gabriel_into
from triform.threads import in_parts
from triform.types import FloatArray, View, require


@njit(cache=True, nogil=True)
def _spring_command(centres, count, distance, gain, max_speed, out):  # type: ignore[no-untyped-def]
    """Write Eq. 8 over the Gabriel neighbours of a robot at the origin among ``count`` centres, shape (3,)."""
    positions = np.zeros((count + 1, 2))
    positions[1:] = centres[:count]
    active = np.ones(count + 1, dtype=np.bool_)
    edges = np.empty((count + 1, count + 1), dtype=np.bool_)
    gabriel_into(positions, active, np.inf, edges)
    u_x = u_y = 0.0
    for j in range(1, count + 1):
        length = np.hypot(positions[j, 0], positions[j, 1])
        if edges[0, j] and length > 0.0:
            pull = gain * (length - distance) / length
            u_x += pull * positions[j, 0]
            u_y += pull * positions[j, 1]
    speed = np.hypot(u_x, u_y)
    scale = max_speed / speed if speed > max_speed else 1.0
    out[0], out[1], out[2] = scale * u_x, scale * u_y, 0.0


@njit(cache=True, nogil=True)
def _command_robots(  # type: ignore[no-untyped-def]
    ranges, active, footprint, directions, angle_min, range_max, distance, gain, max_speed, out, first, last
):
    """Write the body twists (M, 3) of the robots ``first <= m < last`` from their scans (M, R)."""
    centres = np.empty((most_robots(ranges.shape[1]), 2))
    for m in range(first, last):
        out[m] = 0.0
        if active[m]:
            count = detect_into(ranges[m], footprint, directions, angle_min, range_max, centres)
            _spring_command(centres, count, distance, gain, max_speed, out[m])


class ScanPipeline:
    """Model-based ``Controller[View]``: detected centres, Gabriel graph, Eq. 8.

    ``u_i = gain * sum_j (r_ij - d*) e_ij`` over the Gabriel neighbours j among the robots detected in robot i's own
    scan, with ``e_ij`` the unit vector towards j: a neighbour that is too far attracts. (As printed, Eq. 8 has the
    opposite sign and repels it.) The command is clipped to ``max_speed`` keeping its direction, and robots do not
    turn. A robot that sees nobody stands still.
    """

    privileged = False

    def __init__(
        self,
        distance: float = 1.0,
        gain: float = 1.0,
        max_speed: float = 1.0,
        footprint: tuple[float, float] | float = ROBOMASTER_EP_SIZE,
    ) -> None:
        """Make a pipeline.

        Args:
            distance: Prescribed neighbour distance d* [m].
            gain: Spring gain [1/s].
            max_speed: Longer commands are scaled to this speed [m/s], keeping their direction.
            footprint: Length and width of the robots' box, or the diameter of a circle [m].

        Raises:
            ConfigurationError: If a value is not positive, or one other than ``max_speed`` not finite.
        """
        require(0 < distance < np.inf, f"distance is {distance} m; it must be positive and finite")
        require(0 < gain < np.inf, f"gain is {gain} 1/s; it must be positive and finite")
        require(max_speed > 0, f"max_speed is {max_speed} m/s; it must be positive")
        self._footprint = kernel_footprint(footprint)
        self._law = (float(distance), float(gain), float(max_speed))

    @property
    def description(self) -> dict[str, Any]:
        """Name and settings, plain JSON values."""
        half_length, half_width, round_ = self._footprint
        distance, gain, max_speed = self._law
        return {
            "name": "scan-pipeline",
            "distance": distance,
            "gain": gain,
            "max_speed": max_speed,
            "footprint": {"shape": "circle" if round_ else "box", "length": 2 * half_length, "width": 2 * half_width},
        }

    def command(self, view: View) -> FloatArray:
        """Return body twists, shape (B, N, 3)."""
        scan = view.scans
        ranges = np.ascontiguousarray(scan.ranges).reshape(-1, scan.config.rays)
        active = view.active.reshape(-1)
        directions, config = ray_directions(scan), scan.config
        out = np.empty((len(ranges), 3))
        in_parts(
            lambda first, last: _command_robots(
                ranges, active, self._footprint, directions, config.angle_min, config.range_max, *self._law, out,
                first, last,
            ),
            len(ranges), len(ranges), SCANS_PER_THREAD,
        )  # fmt: skip
        return out.reshape(*view.active.shape, 3)
