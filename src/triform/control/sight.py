"""Whether a robot sees: no measurement is not free space.

A controller takes an empty scan for an empty room, and one that searches for its team would drive off blind. Scans
alone cannot tell an empty hall from a LiDAR whose laser is dead, covered or blinded, least of all those of LDROBOT's,
which send a distance of 0 for both. So a robot trusts its LiDAR only while something comes back: a return from anywhere
within the LiDAR's full reach, near enough for the controller or not, and measurements in most directions.

One turn without sight may be a glitch: the robot slows with each and stands after ``BLIND_TURNS``. One turn with sight
lets it go on. So a robot alone in a hall wider than its LiDAR reaches stands, until somebody comes.
"""

from __future__ import annotations

import numpy as np

from triform.types import BoolArray, RangeArray

#: Turns without sight after which a robot stands.
BLIND_TURNS = 3
#: Share of the directions in which a LiDAR is to look that may be unknown (``NaN``) in a turn with sight.
MOST_UNKNOWN = 0.5


def has_sight(ranges: RangeArray, looks: BoolArray) -> bool:
    """Tell whether a turn shows that the LiDAR measures.

    Args:
        ranges: Ranges up to the LiDAR's full reach [m], shape (R,); REP 117 for what is no range. What the robot itself
            returns must be ``NaN``.
        looks: Rays that are to measure, shape (R,): those outside of blind sectors.
    """
    seen = ranges[looks]
    unknown = np.isnan(seen)
    returns = (seen < np.inf) & ~unknown
    return bool(returns.any() and unknown.mean() <= MOST_UNKNOWN)


class Sight:
    """Counts turns without sight; a robot begins blind."""

    def __init__(self) -> None:
        self._blind_turns = BLIND_TURNS

    def note(self, sees: bool) -> None:
        """Take the next turn, and whether it has sight."""
        self._blind_turns = 0 if sees else self._blind_turns + 1

    @property
    def trust(self) -> float:
        """Share of its command that the robot may drive: 1 with sight, less with every turn without, at last 0."""
        return max(0.0, 1 - self._blind_turns / BLIND_TURNS)
