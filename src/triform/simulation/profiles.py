"""Robot profiles: what a robot looks like, senses with, drives with, and how fast it thinks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from triform.geometry.footprint import ROBOMASTER_EP, Footprint
from triform.geometry.unicycle import Wheels
from triform.simulation.intensity import Brightness
from triform.simulation.mounting import Mounting
from triform.types import (
    ScanConfig,
    convert_fields,
    require,
)

#: Kinds of bases.
KINDS = ("holonomic", "differential")


def _is_positive(value: float) -> bool:
    return 0 < value < math.inf


@dataclass(frozen=True)
class NoiseBand:
    """Standard deviation of a measured range, up to a distance: ``absolute + relative * range``.

    Attributes:
        up_to: Largest true range this band speaks about [m]; ``inf`` for the last band.
        absolute: Constant part [m].
        relative: Part proportional to the range [1].
    """

    up_to: float
    absolute: float = 0.0
    relative: float = 0.0

    def __post_init__(self) -> None:
        convert_fields(self)
        require(self.up_to > 0, f"a noise band ends at {self.up_to} m; it must be positive")
        require(
            0 <= self.absolute < math.inf and 0 <= self.relative < math.inf,
            f"noise of {self.absolute} m + {self.relative} x range; neither part may be negative or infinite",
        )


@dataclass(frozen=True)
class LidarConfig:
    """A LiDAR: the shape of its scan, its errors and its timing.

    Attributes:
        scan: Rays and limits of range.
        noise: Gaussian range noise by distance, bands in growing order, the last up to ``inf``; empty means none.
        angle_noise: Standard deviation of every ray's direction [rad]; the ray is really cast that way.
        dropout: Share of rays, drawn independently, that return nothing valid (``NaN``).
        rolling: Whether each ray is measured at its own moment of the turn; otherwise all at the turn's end.
        period: Time of one turn [s].
        intensities: Whether it can say how bright its returns are.
        brightness: How bright it sees robots and obstacles.
        min_intensity: Returns that are dimmer, in its own scale, are obstacles, because robots wear reflecting tape;
            ``None`` if it cannot or need not tell. Intensities are only simulated with such a threshold.
    """

    scan: ScanConfig = field(default_factory=ScanConfig)
    noise: tuple[NoiseBand, ...] = ()
    angle_noise: float = 0.0
    dropout: float = 0.0
    rolling: bool = False
    period: float = 0.1
    intensities: bool = True
    brightness: Brightness = field(default_factory=Brightness)
    min_intensity: float | None = None

    def __post_init__(self) -> None:
        convert_fields(self)
        ends = [band.up_to for band in self.noise]
        require(
            not ends or (ends == sorted(set(ends)) and ends[-1] == math.inf),
            f"noise bands end at {ends} m; they must grow and the last must reach inf",
        )
        require(
            0 <= self.angle_noise < math.inf,
            f"angle_noise is {self.angle_noise} rad; it must be finite and not negative",
        )
        require(0 <= self.dropout <= 1, f"dropout is {self.dropout}; it is a share between 0 and 1")
        require(_is_positive(self.period), f"LiDAR period is {self.period} s; it must be positive and finite")
        threshold = self.min_intensity
        require(
            threshold is None or 0 <= threshold < math.inf,
            f"min_intensity is {threshold}; it must be finite and not negative",
        )
        require(
            threshold is None or self.intensities,
            f"min_intensity is {threshold}, but this LiDAR does not say how bright its returns are",
        )

    @property
    def largest_noise(self) -> float:
        """Largest standard deviation of a range that it can measure [m]."""
        starts = [0.0, *(band.up_to for band in self.noise)]
        return max(
            (
                band.absolute + band.relative * min(band.up_to, self.scan.range_max)
                for start, band in zip(starts, self.noise, strict=False)
                if start < self.scan.range_max
            ),
            default=0.0,
        )


def constant_noise(sigma: float) -> tuple[NoiseBand, ...]:
    """Return range noise with one standard deviation ``sigma`` [m] at every distance."""
    return (NoiseBand(math.inf, absolute=sigma),)


@dataclass(frozen=True)
class Drive:
    """What the base can do with a commanded body twist; ``inf`` means no limit.

    Attributes:
        max_speed: Largest translational speed [m/s]; faster commands are shortened and keep their direction.
        max_axis_speed: Largest speed along x and along y [m/s]; each axis is clipped by itself, as the robot's
            own software does, so that the direction may change.
        max_turn_rate: Largest turn rate [rad/s].
        max_acceleration: Largest norm of the translational acceleration [m/s^2].
        max_turn_acceleration: Largest angular acceleration [rad/s^2].
        lag: Time constant of the first-order actuator lag [s]; 0 means none.
        kind: ``"holonomic"``, or ``"differential"``: two driven wheels on an axle through the centre, which turn the
            robot to where it is to go. ``max_speed`` is then the speed along its axis.
        track: Distance between the wheels of a differential base [m].
        max_wheel_speed: Largest speed of one of these wheels [m/s].
        reverse: Whether a differential base may drive backwards.
        wheel_radius: Radius of a differential base's driven wheels [m], for simulators that have wheels; by default a
            TurtleBot3's.
    """

    max_speed: float = 0.5
    max_axis_speed: float = math.inf
    max_turn_rate: float = math.inf
    max_acceleration: float = math.inf
    max_turn_acceleration: float = math.inf
    lag: float = 0.0
    kind: Literal["holonomic", "differential"] = "holonomic"
    track: float = 0.0
    max_wheel_speed: float = math.inf
    reverse: bool = True
    wheel_radius: float = 0.033

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in (
            "max_speed", "max_axis_speed", "max_turn_rate", "max_acceleration", "max_turn_acceleration",
            "max_wheel_speed",
        ):  # fmt: skip
            value = getattr(self, name)
            require(value > 0, f"{name} is {value}; it must be positive (inf for no limit)")
        require(0 <= self.lag < math.inf, f"lag is {self.lag} s; it must be finite and not negative")
        require(self.kind in KINDS, f"kind is {self.kind!r}; allowed are {', '.join(KINDS)}")
        require(0 <= self.track < math.inf, f"track is {self.track} m; it must be finite and not negative")
        require(
            _is_positive(self.wheel_radius), f"wheel_radius is {self.wheel_radius} m; it must be positive and finite"
        )
        require(
            not self.is_differential or self.max_turn_rate < math.inf,
            "max_turn_rate is inf; a differential base turns to where it is to go, so its turn rate has a limit",
        )

    @property
    def is_differential(self) -> bool:
        """Whether the base has two driven wheels."""
        return self.kind == "differential"

    @property
    def braking_lag(self) -> float:
        """Lag with which a robot at full speed would brake on the way that its limit of acceleration takes [s]."""
        return self.lag + min(self.max_speed, self.max_axis_speed) / (2 * self.max_acceleration)

    @property
    def turning_lag(self) -> float:
        """The same for the fastest turn of a differential base [s]."""
        return self.lag + self.max_turn_rate / (2 * self.max_turn_acceleration)

    @property
    def wheels(self) -> Wheels | None:
        """The limits of a differential base as kernels take them; ``None`` for a holonomic one."""
        if not self.is_differential:
            return None
        speed = min(self.max_speed, self.max_axis_speed)
        # Kernels are compiled for floats alone.
        return Wheels(
            float(speed), float(self.max_turn_rate), self.track / 2, float(self.max_wheel_speed), self.reverse
        )


@dataclass(frozen=True)
class Profile:
    """A kind of robot.

    Attributes:
        name: Name, recorded with results.
        footprint: Outline seen by others' LiDARs and used for overlaps.
        lidar: Its only sensor.
        drive: Its base.
        control_period: Time between two commands [s].
        latency: Time from a finished scan until a command can use it [s].
        time_step: Longest integration step [s].
        odometry: Whether a robot's wheels tell it how far it has come.
        mounting: Where the LiDAR is on the base, and what it cannot see from there. A simulated LiDAR's own errors and
            the order of its rays do not depend on its yaw, nor on whether it is upright.
    """

    name: str
    footprint: Footprint = ROBOMASTER_EP
    lidar: LidarConfig = field(default_factory=LidarConfig)
    drive: Drive = field(default_factory=Drive)
    control_period: float = 0.1
    latency: float = 0.0
    time_step: float = 0.01
    odometry: bool = True
    mounting: Mounting = field(default_factory=Mounting)

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("control_period", "time_step"):
            value = getattr(self, name)
            require(_is_positive(value), f"{name} is {value} s; it must be positive and finite")
        require(0 <= self.latency < math.inf, f"latency is {self.latency} s; it must be finite and not negative")

    def seeing(self, reach: float) -> Profile:
        """Return these robots with a LiDAR that looks up to ``reach`` far [m]."""
        return replace(self, lidar=replace(self.lidar, scan=replace(self.lidar.scan, range_max=reach)))

    def require_holonomic(self, body: str) -> None:
        """Refuse a differential base.

        Args:
            body: What drives holonomic robots alone, for the sentence that refuses.

        Raises:
            ConfigurationError: The base is differential.
        """
        require(
            not self.drive.is_differential,
            f"the profile {self.name!r} has a differential base, and {body} drives holonomic robots alone",
        )

    @property
    def from_lidar(self) -> ScanConfig:
        """The scan from where the LiDAR is: as far beyond what the robot uses as the LiDAR is off its centre."""
        return replace(self.lidar.scan, range_max=self.lidar.scan.range_max + self.mounting.offset)


IDEAL = Profile("ideal")

#: LDROBOT LD20 on a RoboMaster EP. The data sheet's "+-5 mm to 0.5 m, +-10 mm to 1 m, +-1 % beyond" is read as
#: two standard deviations: an accuracy figure names a band that nearly all samples (95 %) keep to.
#: The sheet says nothing about errors of angle (none here), and the lag of 0.1 s is an assumption.
HARDWARE = Profile(
    "hardware",
    lidar=LidarConfig(
        scan=ScanConfig(rays=667, range_min=0.1),
        noise=(
            NoiseBand(0.5, absolute=0.0025),
            NoiseBand(1.0, absolute=0.005),
            NoiseBand(math.inf, relative=0.005),
        ),
        dropout=0.01,
        rolling=True,
        period=1 / 6,
    ),
    drive=Drive(max_axis_speed=0.1, max_turn_rate=math.radians(600), lag=0.1),
    control_period=1 / 8,
    latency=0.12,
)
