"""How bright a simulated LiDAR sees what its rays hit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from triform.types import FloatArray, RangeArray, convert_fields, require


@dataclass(frozen=True)
class Brightness:
    """How bright a LiDAR sees materials, in its own scale; the defaults are in that of LDROBOT's LiDARs, 0 to 255.

    The manual of the LD19 (Development Manual 2.5, "Data Format") gives 200 for white objects within 6 m. That is the
    default of all obstacles, the hardest case: most furniture is darker. That reflecting tape comes near to the end of
    the scale, and the noise, are assumptions. A grazing ray returns as much as a straight one here, which is wrong for
    all materials; tape returns less from 30 to 50 degrees on, as its data sheet says.

    Attributes:
        robot: Of robots, which wear reflecting tape.
        obstacle: Of walls and pillars for which the arena says nothing else.
        falloff: Lost per distance [1/m].
        noise: Standard deviation of the noise.
        largest: End of the scale; brighter returns are as bright.
    """

    robot: float = 250.0
    obstacle: float = 200.0
    falloff: float = 0.0
    noise: float = 8.0
    largest: float = 255.0

    def __post_init__(self) -> None:
        convert_fields(self)
        require(0 < self.largest < math.inf, f"largest is {self.largest}; it must be positive and finite")
        for name in ("robot", "obstacle"):
            value = getattr(self, name)
            require(0 <= value <= self.largest, f"{name} is {value}; it must lie between 0 and {self.largest:g}")
        for name in ("falloff", "noise"):
            value = getattr(self, name)
            require(0 <= value < math.inf, f"{name} is {value}; it must be finite and not negative")

    def measure(self, levels: FloatArray, ranges: RangeArray, rng: np.random.Generator) -> RangeArray:
        """Return intensities as they are measured, float32.

        Args:
            levels: How bright what each ray hits is from near by, shape (...); ``NaN`` where it hits nothing.
            ranges: Exact ranges, of the same shape [m]; what is too close counts as 0 m away.
            rng: Source of the noise.

        Returns:
            Intensities between 0 and ``largest``, 0 where nothing returned.
        """
        distance = np.where(np.isfinite(ranges), ranges, 0.0)
        measured = levels - self.falloff * distance + self.noise * rng.standard_normal(ranges.shape)
        returned = (ranges < np.inf) & ~np.isnan(levels)
        return np.where(returned, np.clip(measured, 0.0, self.largest), 0.0).astype(np.float32)
