"""Footprints: outlines of robots seen from above."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from triform.types import Body, ConfigurationError, FloatArray, convert_fields, nearest, require


@dataclass(frozen=True)
class Footprint:
    """Outline of a robot seen from above, centred on its base.

    Attributes:
        shape: ``"box"`` or ``"circle"``.
        length: Extent along the robot's x axis (forward) [m]; the diameter of a circle.
        width: Extent along the robot's y axis (left) [m]; the diameter of a circle.
    """

    shape: Literal["box", "circle"]
    length: float
    width: float

    def __post_init__(self) -> None:
        convert_fields(self)
        require(self.shape in ("box", "circle"), f"footprint shape is {self.shape!r}; allowed are box, circle")
        require(
            0 < self.length < math.inf and 0 < self.width < math.inf,
            f"footprint is {self.length} m x {self.width} m; both must be positive and finite",
        )
        require(
            self.shape == "box" or self.length == self.width,
            f"a circle has length = width = diameter, not {self.length} m and {self.width} m",
        )

    @classmethod
    def box(cls, length: float, width: float) -> Footprint:
        """Return a box of ``length`` (forward) times ``width`` (across) [m]."""
        return cls("box", length, width)

    @classmethod
    def circle(cls, diameter: float) -> Footprint:
        """Return a circle of ``diameter`` [m]."""
        return cls("circle", diameter, diameter)

    @classmethod
    def parse(cls, text: str) -> Footprint:
        """Read a name of ``FOOTPRINTS``, ``circle:DIAMETER`` or ``box:LENGTHxWIDTH`` [m].

        Raises:
            ConfigurationError: The text says something else.
        """
        if text in FOOTPRINTS:
            return FOOTPRINTS[text]
        shape, _, sizes = text.partition(":")
        try:
            numbers = [float(size) for size in sizes.split("x")]
        except ValueError:
            numbers = []
        if shape == "circle" and len(numbers) == 1:
            return cls.circle(numbers[0])
        if shape == "box" and len(numbers) == 2:
            return cls.box(numbers[0], numbers[1])
        raise ConfigurationError(
            f"footprint is {text!r}{nearest(text, FOOTPRINTS)}; allowed are {', '.join(FOOTPRINTS)}, circle:DIAMETER "
            "such as circle:0.30 and box:LENGTHxWIDTH such as box:0.41x0.24, in metres"
        )

    @property
    def label(self) -> str:
        """The outline as ``parse`` reads it."""
        length, width = float(self.length), float(self.width)
        return f"circle:{length!r}" if self.is_circle else f"box:{length!r}x{width!r}"

    @property
    def is_circle(self) -> bool:
        """Whether the outline is a circle."""
        return self.shape == "circle"

    @property
    def half_length(self) -> float:
        """Half the length [m]; the radius of a circle."""
        return self.length / 2

    @property
    def half_width(self) -> float:
        """Half the width [m]; the radius of a circle."""
        return self.width / 2

    @property
    def size(self) -> tuple[float, float] | float:
        """Length and width of a box, or the diameter of a circle [m]."""
        return self.length if self.is_circle else (self.length, self.width)

    @property
    def body(self) -> Body:
        """The outline as kernels take it."""
        return Body(float(self.half_length), float(self.half_width), self.is_circle)

    @property
    def circumradius(self) -> float:
        """Radius of the smallest circle around the centre that holds the footprint [m]."""
        return self.half_length if self.is_circle else math.hypot(self.half_length, self.half_width)

    @property
    def corners(self) -> FloatArray:
        """Corners of the bounding box in the robot's frame, counter-clockwise from front left, (4, 2) [m]."""
        signs = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        return np.asarray(signs * [self.half_length, self.half_width], dtype=np.float64)


#: DJI RoboMaster EP.
ROBOMASTER_EP = Footprint.box(0.320, 0.240)

#: Footprints by name. The engineer is a RoboMaster EP with its arm, 410 mm x 240 mm by its data sheet, around its
#: centre as all footprints are; circles are named after their radius in centimetres, the box after its side.
FOOTPRINTS = {
    "ep": ROBOMASTER_EP,
    "engineer": Footprint.box(0.410, 0.240),
    "circle-5": Footprint.circle(0.10),
    "circle-10": Footprint.circle(0.20),
    "circle-15": Footprint.circle(0.30),
    "circle-20": Footprint.circle(0.40),
    "box-30": Footprint.box(0.30, 0.30),
}
