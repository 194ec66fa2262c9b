"""What a team of robots of several kinds senses: a view of each kind, and what all have in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from triform.types import FloatArray, PrivilegedView, Scan, TriformError, as_array, require


class MixedView(PrivilegedView):
    """What B worlds of N robots of several kinds sense at one moment: the robots of each kind follow each other.

    LiDARs of several kinds have no common scans, so ``scans`` refuses; all else is that of the parts, side by side.

    Attributes:
        parts: What the robots of each kind sense, in the order of the robots.
        due: Whether the control period of each kind begins now. If not, its robots hold their commands.
        held: Commands that the robots have had so far, shape (B, N, 3) [m/s, m/s, rad/s].
    """

    parts: tuple[PrivilegedView, ...]
    due: tuple[bool, ...]
    held: FloatArray

    def __init__(self, parts: Sequence[PrivilegedView], due: Sequence[bool], held: FloatArray) -> None:
        """Put parts side by side.

        Raises:
            ConfigurationError: There is no part, or the arguments are of different lengths.
        """
        require(0 < len(parts) == len(due), f"{len(parts)} parts and {len(due)} periods given; each part needs its own")
        own = {
            "parts": tuple(parts),
            "due": tuple(map(bool, due)),
            "held": as_array("held commands", held),
            "active": np.concatenate([part.active for part in parts], axis=1),
            "time": parts[0].time,
            "poses": np.concatenate([part.poses for part in parts], axis=1),
            "noise": _beside([part.noise for part in parts]),
            "odometry": _beside([part.odometry for part in parts]),
        }
        for name, value in own.items():
            object.__setattr__(self, name, value)
        shape = (*self.active.shape, 3)
        require(self.held.shape == shape, f"held commands of shape {self.held.shape} given; {shape} is needed")

    @property
    def scans(self) -> Scan:
        """Nothing: each part has scans of its own.

        Raises:
            TriformError: Always.
        """
        raise TriformError(
            "robots of several profiles have no common scans; a controller sees those of each kind, in the parts of "
            "the view"
        )

    def part_of(self, robot: int) -> tuple[int, int]:
        """Return which part a robot is in, and its index there along axis N."""
        part = next(part for part, own in enumerate(self.robots) if own.start <= robot < own.stop)
        return part, robot - self.robots[part].start

    def with_poses(self, poses: FloatArray) -> MixedView:
        """Return the view with other poses, shape (B, N, 3) [m, m, rad], in its parts too."""
        parts = [part.with_poses(poses[:, own]) for part, own in zip(self.parts, self.robots, strict=True)]
        return MixedView(parts, self.due, self.held)

    @property
    def robots(self) -> tuple[slice, ...]:
        """Which robots each part is about, along axis N."""
        ends = np.cumsum([part.active.shape[1] for part in self.parts]).tolist()
        return tuple(slice(first, last) for first, last in zip([0, *ends], ends, strict=False))


def _beside(values: Sequence[FloatArray | None]) -> FloatArray | None:
    """Values of all parts side by side; ``None`` if a part has none."""
    given = [each for each in values if each is not None]
    return np.concatenate(given, axis=1) if len(given) == len(values) else None
