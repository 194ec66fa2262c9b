"""Robots that wear reflecting tape: returns dimmer than the tape are obstacles, and no neighbours.

No map of ranges can tell a pillar as thick as a robot from a robot. A LiDAR that measures how bright its returns are
can, if robots wear reflecting tape at its height. The controller behind ``IntensityThreshold`` gets scans without the
dim returns; the safety filter in front of it sees all of them, and keeps away from obstacles and robots alike.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Generic

import numpy as np

from triform.types import Controller, FloatArray, Scan, TriformError, ViewIn, converted, require


def bright_returns(scans: Scan, min_intensity: float) -> Scan:
    """Return scans in which a return that is dimmer than ``min_intensity`` is none (``+inf``).

    What is no measurement (``NaN``) stays so.

    Raises:
        TriformError: There are returns, and the scans do not say how bright they are.
    """
    returns = scans.ranges < np.inf
    if scans.intensities is None:
        if returns.any():
            raise TriformError(
                f"min_intensity is {min_intensity:g}, but the scans say nothing about intensities; a LiDAR that "
                "measures them is needed"
            )
        return scans
    dim = returns & ~(scans.intensities >= min_intensity)
    return replace(scans, ranges=np.where(dim, scans.ranges.dtype.type(np.inf), scans.ranges))


class IntensityThreshold(Generic[ViewIn]):
    """Any controller, which sees only returns that are bright enough: a controller for the same views."""

    def __init__(self, controller: Controller[ViewIn], min_intensity: float) -> None:
        """Take a controller.

        Args:
            controller: Any controller.
            min_intensity: Intensity from which a return is of a robot, in the LiDAR's own scale.

        Raises:
            ConfigurationError: The threshold is negative or not finite.
        """
        self._controller = controller
        self._least = converted("min_intensity", min_intensity, float)
        require(0 <= self._least < np.inf, f"min_intensity is {self._least}; it must be finite and not negative")

    @property
    def privileged(self) -> bool:
        """Whether the controller needs a ``PrivilegedView``."""
        return self._controller.privileged

    @property
    def description(self) -> dict[str, Any]:
        """What the controller says, and the threshold as ``min_intensity``."""
        return {**self._controller.description, "min_intensity": self._least}

    def command(self, view: ViewIn) -> FloatArray:
        """Return body twists, shape (B, N, 3).

        Raises:
            TriformError: There are returns, and the scans do not say how bright they are.
        """
        # Of a generic view, dataclasses.replace does not know that it is one.
        seen: Any = replace(view, scans=bright_returns(view.scans, self._least))
        return self._controller.command(seen)
