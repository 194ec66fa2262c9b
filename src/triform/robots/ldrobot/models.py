"""The models that speak the packets of ``packets``."""

from __future__ import annotations

import math
from dataclasses import dataclass

from triform.simulation.profiles import HARDWARE, NoiseBand, constant_noise
from triform.types import ConfigurationError, ScanConfig, choose, convert_fields, require


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


#: Also the LD06, which is older: 4500 samples a second, 5 to 13 turns a second, 0.02 m to 12 m, the same packets
#: (inno-maker.com/product/lidar-ld06; ldrobotSensorTeam/ldlidar_stl_ros2 reads both at 230400 baud as one).
LD19 = LidarModel("LD19", 4500, 1 / 10, 0.02, 12.0, constant_noise(0.010))
#: Also the LD14P.
LD20 = LidarModel("LD20", 4000, 1 / 6, 0.1, 8.0, HARDWARE.lidar.noise)
#: 5000 samples a second (wiki.youyeetoo.com/en/Lidar/D300), read at 230400 baud by the driver of the LD19 with 504
#: samples in a turn of 0.1 s. Range and noise are assumed to be the LD19's.
STL_19P = LidarModel("STL-19P", 5000, 1 / 10, 0.02, 12.0, LD19.noise)

#: Models by name.
MODELS = {"ld19": LD19, "ld06": LD19, "stl-19p": STL_19P, "ld20": LD20, "ld14p": LD20}
#: How names of LiDARs with another protocol begin, and who makes them; each has a ROS 2 driver of its maker's.
_OTHERS = {
    "rplidar": "SLAMTEC's RPLIDAR", "slamtec": "SLAMTEC's RPLIDAR", "ydlidar": "YDLIDAR", "hokuyo": "Hokuyo",
    "urg": "Hokuyo", "ust": "Hokuyo", "utm": "Hokuyo", "sick": "SICK", "tim": "SICK", "lms": "SICK",
}  # fmt: skip


def get_model(name: str) -> LidarModel:
    """Return a LiDAR by the name of its model.

    Raises:
        ConfigurationError: There is no such model, or it speaks another protocol and goes with ROS 2.
    """
    spelled = name.lower()
    for begin, maker in _OTHERS.items():
        if spelled.startswith(begin):
            raise ConfigurationError(
                f"the LiDAR {name!r} is one of {maker}, whose protocol triform does not read; run its ROS 2 driver "
                "and, on its scans, the ROS 2 package triform_ros"
            )
    return choose("LiDAR model", spelled, MODELS)
