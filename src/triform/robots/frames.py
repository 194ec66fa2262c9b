"""Rigid transforms between frames that do not move, and the mounting of a LiDAR that they tell."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from triform.simulation import Mounting
from triform.types import FloatArray, require

#: A LiDAR whose axis is farther from the vertical does not scan in the plane [rad].
MOST_TILT = math.radians(3)
#: A quaternion whose length is farther from 1 is none of a rotation.
_LENGTH_SLACK = 0.01


class FrameTree:
    """Frames, each with its pose in its parent; adding a frame again replaces its pose."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, FloatArray]] = {}

    def add(self, parent: str, child: str, translation: Sequence[float], rotation: Sequence[float]) -> None:
        """Add a frame.

        Args:
            parent: Frame in which the pose is.
            child: Its name.
            translation: Its origin, shape (3,) [m].
            rotation: Its orientation, a unit quaternion (x, y, z, w).

        Raises:
            ConfigurationError: The rotation is no unit quaternion, or the translation is not finite.
        """
        place, turn = np.asarray(translation, dtype=np.float64), np.asarray(rotation, dtype=np.float64)
        length = float(np.linalg.norm(turn))
        require(
            abs(length - 1) <= _LENGTH_SLACK and bool(np.isfinite(place).all()),
            f"the frame {child!r} is at {place.tolist()} m with the quaternion {turn.tolist()}; finite numbers and a "
            "quaternion of length 1 are needed",
        )
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = _rotation_matrix(turn / length), place
        self._parents[child] = (parent, pose)

    def pose(self, frame: str, base: str) -> FloatArray | None:
        """Return the pose of ``frame`` in ``base``, shape (4, 4); ``None`` if no chain of transforms joins them."""
        poses = self._to_ancestors(frame)
        for ancestor, base_pose in self._to_ancestors(base).items():
            if ancestor in poses:
                return np.asarray(np.linalg.inv(base_pose) @ poses[ancestor])
        return None

    def _to_ancestors(self, frame: str) -> dict[str, FloatArray]:
        """Return the pose of a frame in itself and in each of its ancestors, nearest first."""
        poses, pose = {frame: np.eye(4)}, np.eye(4)
        while frame in self._parents:
            frame, step = self._parents[frame]
            if frame in poses:
                break
            pose = step @ pose
            poses[frame] = pose
        return poses


def mounting_of(pose: FloatArray, blind_sectors: tuple[tuple[float, float], ...] = ()) -> Mounting:
    """Return the mounting of a LiDAR that scans in the x-y plane of its own frame.

    Args:
        pose: Of that frame in the base's, shape (4, 4).
        blind_sectors: See ``Mounting``; no transform tells them.

    Raises:
        ConfigurationError: The LiDAR is tilted.
    """
    tilt = math.acos(min(1.0, abs(float(pose[2, 2]))))
    require(
        tilt <= MOST_TILT,
        f"the LiDAR is tilted by {math.degrees(tilt):.0f} degrees; it must scan in the horizontal plane, upright or "
        "upside down",
    )
    yaw = math.atan2(pose[1, 0], pose[0, 0])
    return Mounting(float(pose[0, 3]), float(pose[1, 3]), yaw, bool(pose[2, 2] > 0), blind_sectors)


def _rotation_matrix(quaternion: FloatArray) -> FloatArray:
    """Return the rotation of a unit quaternion (x, y, z, w), shape (3, 3)."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
