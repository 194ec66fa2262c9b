"""The controllers that a practitioner would write from one scan, without learning.

Scan -> centres of the neighbours (``detection``) -> Gabriel graph -> a law: Eq. 8 or the triangulating law. They see
exactly what the learned policies see, but are told the footprint of the robots.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np

from triform.control.detection import (
    ROBOMASTER_EP_SIZE,
    SCANS_PER_THREAD,
    UNKNOWN_BODY,
    detect_into,
    fitted_footprint,
    most_robots,
    ray_directions,
    require_noise,
)
from triform.control.last_step import LastStep, robot_rows
from triform.control.triangulating import TriangulatingLaw
from triform.control.triangulating_kernels import law_workspace, triangulate
from triform.geometry.gabriel import gabriel_into
from triform.kernels import kernel
from triform.threads import in_parts
from triform.types import SENSING_RANGE, Body, FloatArray, View, require


@kernel
def _spring_command(centres, count, distance, gain, max_speed, out):
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


@kernel
def _shift(centres, count, odometry):
    """Give ``count`` centres as seen from where the robot has moved to since its scan, shape (3,)."""
    cos, sin = np.cos(odometry[2]), np.sin(odometry[2])
    for j in range(count):
        x, y = centres[j, 0] - odometry[0], centres[j, 1] - odometry[1]
        centres[j, 0], centres[j, 1] = cos * x + sin * y, cos * y - sin * x


class _Seen(NamedTuple):
    """What M robots see.

    Attributes:
        ranges: Ranges of their scans [m], shape (M, R).
        asked: Robots that need a command, shape (M,).
        odometry: Their poses now in their body frames at the moments of their scans [m, m, rad], shape (M, 3).
        footprint: Outline of all robots; ``UNKNOWN_BODY`` to estimate it.
        noise: Standard deviation of the ranges [m].
        directions: Unit vectors of the rays, shape (R, 2).
        angle_min: Angle of the first ray [rad].
        range_max: Farther returns are not used [m].
    """

    ranges: Any
    asked: Any
    odometry: Any
    footprint: Body
    noise: float
    directions: Any
    angle_min: float
    range_max: float


@kernel
def _detect(seen, m, centres):
    """Write the centres of the robots that robot m sees, from where it is now; return their number."""
    count = detect_into(
        seen.ranges[m], seen.footprint, seen.directions, seen.angle_min, seen.range_max, seen.noise, centres
    )
    _shift(centres, count, seen.odometry[m])
    return count


@kernel
def _command_robots(seen, distance, gain, max_speed, out, first, last):
    """Write the body twists (M, 3) of the robots ``first <= m < last`` that need one by Eq. 8 from what they see."""
    centres = np.empty((most_robots(seen.ranges.shape[1]), 2))
    for m in range(first, last):
        if seen.asked[m]:
            count = _detect(seen, m, centres)
            _spring_command(centres, count, distance, gain, max_speed, out[m])


@kernel
def _triangulating_command(centres, count, distance, law, max_speed, noise, workspace, out):
    """Write the triangulating law for a robot at the origin among ``count`` centres, shape (3,)."""
    x, y = workspace.x, workspace.y
    x[0] = y[0] = 0.0
    points, reach = 1, law.sight * distance
    for j in range(count):
        # The near side of a robot beyond the law's sight may be within it.
        if np.hypot(centres[j, 0], centres[j, 1]) <= reach:
            x[points], y[points] = centres[j, 0] / distance, centres[j, 1] / distance
            points += 1
    v_x, v_y, amplitude = triangulate(points, law, workspace)
    u_x = distance * (v_x + amplitude * noise[0])
    u_y = distance * (v_y + amplitude * noise[1])
    speed = np.hypot(u_x, u_y)
    scale = max_speed / speed if speed > max_speed else 1.0
    out[0], out[1], out[2] = scale * u_x, scale * u_y, 0.0


@kernel
def _triangulate_robots(seen, distance, law, max_speed, noise, out, first, last):
    """As ``_command_robots`` by the triangulating law, with exploration noise of shape (M, 2)."""
    points = most_robots(seen.ranges.shape[1]) + 1
    centres = np.empty((points, 2))
    workspace = law_workspace(points)
    for m in range(first, last):
        if seen.asked[m]:
            count = _detect(seen, m, centres)
            _triangulating_command(centres, count, distance, law, max_speed, noise[m], workspace, out[m])


def _describe_body(body: Body) -> dict[str, Any] | str:
    """Return a footprint as plain JSON values."""
    if body == UNKNOWN_BODY:
        return "unknown"
    shape = "circle" if body.is_circle else "box"
    return {"shape": shape, "length": 2 * body.half_length, "width": 2 * body.half_width}


class ScanPipeline:
    """Model-based ``Controller[View]``: detected centres, Gabriel graph, and one of two laws.

    The command is clipped to ``max_speed`` keeping its direction, and robots do not turn. A robot that sees nobody
    stands still.

    **Springs**, Eq. 8: ``u_i = gain * sum_j (r_ij - d*) e_ij`` over the Gabriel neighbours j among the robots detected
    in robot i's own scan within 2 d*, with ``e_ij`` the unit vector towards j: a neighbour that is too far attracts.
    (As printed, Eq. 8 has the opposite sign and repels it.)

    **Triangulating**: ``TriangulatingLaw``, with its exploration noise if the view carries one. It uses returns
    and robots within the law's sight, whatever the range of the LiDAR.

    It is given the footprint and the noise, an advantage over a learned policy, which has to do with any: the footprint
    corrects the bias of what is seen, the near side of each robot, and tells robots from walls. Without a footprint, it
    estimates one from each scan.
    """

    privileged = False

    def __init__(
        self,
        distance: float = 1.0,
        gain: float = 1.0,
        max_speed: float = 1.0,
        footprint: tuple[float, float] | float | None = ROBOMASTER_EP_SIZE,
        law: TriangulatingLaw | None = None,
        noise: float = 0.0,
    ) -> None:
        """Make a pipeline.

        Args:
            distance: Prescribed neighbour distance d* [m].
            gain: Gain of the springs [1/s]; the triangulating law has its own.
            max_speed: Longer commands are scaled to this speed [m/s], keeping their direction.
            footprint: Length and width of the robots' box, or the diameter of a circle [m]; ``None`` to estimate it
                from each scan.
            law: What to do about the robots detected: the triangulating law, or springs if ``None``.
            noise: Standard deviation of measured ranges [m], with which what the fit allows grows.

        Raises:
            ConfigurationError: If a value is not positive, but for the noise, which must not be negative; or if one
                other than ``max_speed`` is not finite.
        """
        require(0 < distance < np.inf, f"distance is {distance} m; it must be positive and finite")
        require(0 < gain < np.inf, f"gain is {gain} 1/s; it must be positive and finite")
        require(max_speed > 0, f"max_speed is {max_speed} m/s; it must be positive")
        require_noise(noise)
        self._footprint = fitted_footprint(footprint)
        self._noise = float(noise)
        self._springs = (float(distance), float(gain), float(max_speed))
        self._law = law
        self._last = LastStep()

    @property
    def description(self) -> dict[str, Any]:
        """Name and settings, plain JSON values."""
        distance, gain, max_speed = self._springs
        law = self._law
        return {
            "name": "scan-pipeline" if law is None else "scan-triangulating",
            "distance": distance,
            **({"gain": gain} if law is None else {"law": asdict(law)}),
            "max_speed": max_speed,
            "footprint": _describe_body(self._footprint),
            "noise": self._noise,
        }

    def command(self, view: View) -> FloatArray:
        """Return body twists, shape (B, N, 3)."""
        scan = view.scans
        ranges = np.ascontiguousarray(scan.ranges).reshape(-1, scan.config.rays)
        active = view.active.reshape(-1)
        odometry, noise = robot_rows(view.odometry, len(ranges), 3), robot_rows(view.noise, len(ranges), 2)
        asked, out = self._last.compare(scan, np.concatenate([odometry, noise], axis=1), active, 3)
        sight = (ranges, asked, odometry, self._footprint, self._noise, ray_directions(scan), scan.config.angle_min)
        distance, gain, max_speed = self._springs
        law = self._law

        def steer(first: int, last: int) -> None:
            if law is None:
                seen = _Seen(*sight, min(scan.config.range_max, SENSING_RANGE * distance))
                _command_robots(seen, distance, gain, max_speed, out, first, last)
            else:
                seen = _Seen(*sight, min(scan.config.range_max, law.sight * distance))
                _triangulate_robots(seen, distance, law.constants, max_speed, noise, out, first, last)

        in_parts(steer, len(ranges), len(ranges), SCANS_PER_THREAD)
        self._last.keep()
        return np.where(active[:, None], out, 0.0).reshape(*view.active.shape, 3)
