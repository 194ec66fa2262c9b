"""The model-based expert, Eq. 7-9: springs along the edges of the Gabriel graph."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from triform.geometry import gabriel_into
from triform.geometry.gabriel import PAIRS_PER_THREAD
from triform.threads import threads_for
from triform.types import FloatArray, PrivilegedView, TriformError, require

#: Reach of the paper's LiDAR, to which ``expert-sensed`` is restricted [m].
SENSING_RANGE = 2.0


@njit(cache=True, nogil=True)
def expert_into(poses, active, distance, gain, max_speed, sensing_range, graph, out):  # type: ignore[no-untyped-def]
    """Write the expert's body twists of one world.

    Args:
        poses: Poses in the world frame [m, m, rad], shape (N, 3).
        active: Robots that exist, shape (N,).
        distance: Prescribed neighbour distance d* [m].
        gain: Spring gain [1/s].
        max_speed: Speed to which a longer command is scaled [m/s].
        sensing_range: Farther robots are not seen [m].
        graph: Room for the Gabriel graph, bool, shape (N, N); holds it afterwards.
        out: Body twists to fill [m/s, m/s, rad/s], shape (N, 3).
    """
    gabriel_into(poses, active, sensing_range, graph)
    robots = poses.shape[0]
    for i in range(robots):
        v_x, v_y = 0.0, 0.0
        if active[i]:
            for j in range(robots):
                if graph[i, j]:
                    d_x = poses[j, 0] - poses[i, 0]
                    d_y = poses[j, 1] - poses[i, 1]
                    length = np.sqrt(d_x * d_x + d_y * d_y)
                    if length > 0.0:
                        pull = gain * (length - distance) / length
                        v_x += pull * d_x
                        v_y += pull * d_y
            speed = np.sqrt(v_x * v_x + v_y * v_y)
            if speed > max_speed:
                v_x *= max_speed / speed
                v_y *= max_speed / speed
        cos, sin = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        out[i, 0] = cos * v_x + sin * v_y
        out[i, 1] = -sin * v_x + cos * v_y
        out[i, 2] = 0.0


@njit(cache=True, nogil=True, parallel=True)
def _expert_worlds(poses, active, distance, gain, max_speed, sensing_range, out):  # type: ignore[no-untyped-def]
    robots = poses.shape[1]
    for b in prange(poses.shape[0]):
        graph = np.empty((robots, robots), dtype=np.bool_)
        expert_into(poses[b], active[b], distance, gain, max_speed, sensing_range, graph, out[b])


class Expert:
    """Expert of Eq. 7-9, a ``Controller[PrivilegedView]``.

    Robot i moves down the gradient of ``gain/2 * sum_j (|p_i - p_j| - d*)^2`` over its Gabriel neighbours j. Eq. 8
    as printed has the opposite sign of ``(p_i - p_j)``, which would push far neighbours away; here they attract.
    Coincident robots exert no force on each other: no direction is defined. The turn rate is always zero.
    """

    privileged = True

    def __init__(
        self,
        distance: float = 1.0,
        gain: float = 1.0,
        max_speed: float = 1.0,
        sensing_range: float = np.inf,
    ) -> None:
        """Make an expert.

        Args:
            distance: Prescribed neighbour distance d* [m].
            gain: Spring gain [1/s].
            max_speed: Longer commands are scaled to this speed [m/s], keeping their direction.
            sensing_range: Farther robots are not seen [m].

        Raises:
            ConfigurationError: If a value is not positive.
        """
        for name, value in (
            ("distance", distance),
            ("gain", gain),
            ("max_speed", max_speed),
            ("sensing_range", sensing_range),
        ):
            require(value > 0, f"{name} is {value}; it must be positive")
        self.distance = distance
        self.gain = gain
        self.max_speed = max_speed
        self.sensing_range = sensing_range

    @property
    def description(self) -> dict[str, Any]:
        """Name and settings; an unlimited sensing range is ``None``."""
        return {
            "name": "expert" if np.isinf(self.sensing_range) else "expert-sensed",
            "distance": self.distance,
            "gain": self.gain,
            "max_speed": self.max_speed,
            "sensing_range": None if np.isinf(self.sensing_range) else self.sensing_range,
        }

    def command(self, view: PrivilegedView) -> FloatArray:
        """Return body twists (B, N, 3) from true poses.

        Raises:
            TriformError: If the view carries no poses.
        """
        if not isinstance(view, PrivilegedView):
            raise TriformError("the expert needs true poses, and this team cannot offer them")
        out = np.empty_like(view.poses)
        with threads_for(view.active.size * view.active.shape[1], PAIRS_PER_THREAD):
            _expert_worlds(
                np.ascontiguousarray(view.poses),
                np.ascontiguousarray(view.active),
                self.distance,
                self.gain,
                self.max_speed,
                self.sensing_range,
                out,
            )
        out[~view.active] = 0.0
        return out
