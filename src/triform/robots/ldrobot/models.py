"""The models that speak the packets of ``packets``."""

from __future__ import annotations

import math
from dataclasses import dataclass

from triform.simulation.profiles import HARDWARE, NoiseBand, constant_noise
from triform.types import ScanConfig, convert_fields, require


@dataclass(frozen=True)
class LidarModel:
    """A LiDAR as its data sheet describes it.

    Attributes:
        name: Name of the model.
        samples_per_second: Ranges measured per second.
        period: Time of one turn at the usual speed [s].
        range_min: Nearest range that it measures [m].
        range_max: Farthest range that it measures [m].
        noise: Range noise by distance, for emulation.
    """

    name: str
    samples_per_second: float
    period: float
    range_min: float
    range_max: float
    noise: tuple[NoiseBand, ...] = ()

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("samples_per_second", "period"):
            value = getattr(self, name)
            require(0 < value < math.inf, f"{name} is {value}; it must be positive and finite")
        require(self.rays >= 1, f"{self.samples_per_second} samples/s are none in a turn of {self.period} s")
        self.scan_config()

    @property
    def rays(self) -> int:
        """Rays of the fixed grid: the samples of a turn at the usual speed."""
        return round(self.samples_per_second * self.period)

    def scan_config(self, range_max: float | None = None) -> ScanConfig:
        """Return the fixed grid that turns are resampled to.

        Args:
            range_max: Farther returns are ``+inf`` [m]; all that the LiDAR measures if ``None``.
        """
        return ScanConfig(self.rays, -math.pi, self.range_min, self.range_max if range_max is None else range_max)


LD19 = LidarModel("LD19", 4500, 1 / 10, 0.02, 12.0, constant_noise(0.010))
#: Also the LD14P.
LD20 = LidarModel("LD20", 4000, 1 / 6, 0.1, 8.0, HARDWARE.lidar.noise)

#: Models by name.
MODELS = {"ld19": LD19, "ld20": LD20, "ld14p": LD20}
