"""Robots that wear reflecting tape: returns dimmer than the tape are obstacles, and no neighbours.

No map of ranges can tell a pillar as thick as a robot from a robot. A LiDAR that measures how bright its returns are
can, if robots wear reflecting tape at its height. The controller behind ``IntensityThreshold`` gets scans without the
dim returns; the safety filter in front of it sees all of them, and keeps away from obstacles and robots alike.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Generic

import numpy as np

from triform.types import Controller, FloatArray, TriformError, ViewIn, converted, require


class IntensityThreshold(Generic[ViewIn]):
    """Any controller, which sees only returns that are bright enough: a controller for the same views.

    A dimmer return becomes none (``+inf``); what is no measurement (``NaN``) stays so.
    """

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
        scans = view.scans
        returns = scans.ranges < np.inf
        if scans.intensities is None:
            if returns.any():
                raise TriformError(
                    f"min_intensity is {self._least:g}, but the scans say nothing about intensities; a LiDAR that "
                    "measures them is needed"
                )
            return self._controller.command(view)
        dim = returns & ~(scans.intensities >= self._least)
        ranges = np.where(dim, scans.ranges.dtype.type(np.inf), scans.ranges)
        # Of a generic view, dataclasses.replace does not know that it is one.
        seen: Any = replace(view, scans=replace(scans, ranges=ranges))
        return self._controller.command(seen)
