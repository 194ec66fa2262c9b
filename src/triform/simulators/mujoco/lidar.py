"""Rays of LiDARs in MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np

from triform.simulation.lidar import HitArray
from triform.simulators.chassis import LIDAR_HEIGHT
from triform.threads import in_parts
from triform.types import BoolArray, FloatArray, RangeArray, ScanConfig

#: Rays that keep a thread busy for a few milliseconds.
_RAYS_PER_THREAD = 10_000


class RayCaster:
    """The LiDARs of N robots, each in the plane of its robot; a robot does not see its own body."""

    def __init__(self, model: mujoco.MjModel, scan: ScanConfig, eye: tuple[float, float] = (0.0, 0.0)) -> None:
        """Take what rays meet, and the rays.

        Args:
            model: Of N robots, as ``write_sight`` writes it.
            scan: Rays of every robot and limits of range.
            eye: Where the LiDAR is on each robot, forward and left of its centre [m].
        """
        self._model = model
        self._scan = scan
        self._eye = np.array([*eye, LIDAR_HEIGHT])
        # Walls and pillars come first in the model, in their order.
        self._obstacles = int(model.body("arena").geomnum[0])

    def cast_into(
        self,
        ranges: RangeArray,
        frames: FloatArray,
        active: BoolArray,
        rays: slice = slice(None),
        offsets: FloatArray | None = None,
        hits: HitArray | None = None,
    ) -> None:
        """Measure some of the rays, at one instant and without errors of range.

        Args:
            ranges: Gets the ranges in place, shape (B, N, R) [m]: ``+inf`` beyond ``range_max``, ``-inf`` below
                ``range_min``; what belongs to robots that do not exist is left alone.
            frames: Positions and orientations of the robots as quaternions, shape (B, N, 7) [m, 1].
            active: Which robots exist, shape (B, N).
            rays: Which rays.
            offsets: Errors of the angles of all rays, shape (B, N, R) [rad].
            hits: Gets what these rays hit in place, shape (B, N, R), as ``cast_moving`` says it.
        """
        angles = self._scan.angles[rays]
        if len(angles) == 0:
            return
        exact = _directions(angles)

        def cast(first: int, last: int) -> None:
            data = mujoco.MjData(self._model)
            found, geometries = np.empty(len(angles)), np.empty(len(angles), np.int32)
            for b in range(first, last):
                data.mocap_pos[:], data.mocap_quat[:] = frames[b, :, :3], frames[b, :, 3:]
                mujoco.mj_kinematics(self._model, data)
                for i in np.flatnonzero(active[b]):
                    body = self._model.body(f"robot{i}").id
                    axes = data.xmat[body].reshape(3, 3).T
                    directions = exact if offsets is None else _directions(angles + offsets[b, i, rays])
                    mujoco.mj_multiRay(
                        self._model, data, data.xpos[body] + self._eye @ axes, (directions @ axes[:2]).ravel(), None,
                        True, body, geometries, found, None, len(angles), self._scan.range_max,
                    )  # fmt: skip
                    ranges[b, i, rays] = self._limited(found)
                    if hits is not None:
                        hits[b, i, rays] = np.minimum(geometries, self._obstacles)

        in_parts(cast, len(frames), active.sum() * len(angles), _RAYS_PER_THREAD)

    def _limited(self, hits: FloatArray) -> FloatArray:
        """Return distances of hits, -1 for none, as ranges [m]."""
        missed = (hits < 0) | (hits > self._scan.range_max)
        return np.where(missed, np.inf, np.where(hits < self._scan.range_min, -np.inf, hits))


def _directions(angles: FloatArray) -> FloatArray:
    """Return unit vectors in the plane of a robot, shape (R, 2)."""
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)
