"""Overrides: what a scenario replaces of its robot profile."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from triform.simulation import Drive, Footprint, LidarConfig, Profile, constant_noise
from triform.types import convert_fields, require

Settings = TypeVar("Settings", LidarConfig, Drive, Profile)

#: Least and largest value and unit of every number; what lies outside is no robot.
_ALLOWED = {
    "range_noise": (0, 10, " m"),
    "dropout": (0, 1, ""),
    "scan_rate": (0.01, 10_000, " Hz"),
    "latency": (0, 60, " s"),
    "speed_limit": (1e-3, 100, " m/s"),
    "acceleration": (1e-3, np.inf, " m/s^2"),
    "lag": (0, 60, " s"),
    "min_intensity": (0, 1e6, ""),
}
#: How far a LiDAR reaches at most [m].
LIDAR_REACH = 8.0


@dataclass(frozen=True)
class Overrides:
    """What replaces values of the robot profile; what is omitted keeps the profile's.

    Attributes:
        range_noise: Standard deviation of measured ranges, the same at every distance [m].
        dropout: Share of rays that return nothing valid.
        scan_rate: LiDAR turns per second [Hz]. A profile whose commands keep step with its scans, such as the ideal
            one, also takes this many commands per second; the hardware profile keeps its own control period.
        latency: Time from a finished scan until a command can use it [s].
        speed_limit: Largest translational speed of the base [m/s]; limits of single axes stay.
        acceleration: Largest translational acceleration of the base [m/s^2].
        lag: Time constant of the base's first-order lag [s].
        footprint: Outline of the robots: a name such as ep, circle:0.30 (diameter) or box:0.41x0.24 [m].
        odometry: Whether robots know from their wheels how far they have come since their scans.
        min_intensity: Intensity of a LiDAR from which a return is of a robot, because robots wear reflecting tape;
            controllers do not see dimmer ones, and the safety filter keeps away from them.
    """

    range_noise: float | None = None
    dropout: float | None = None
    scan_rate: float | None = None
    latency: float | None = None
    speed_limit: float | None = None
    acceleration: float | None = None
    lag: float | None = None
    footprint: str | None = None
    odometry: bool = True
    min_intensity: float | None = None

    def __post_init__(self) -> None:
        convert_fields(self)
        for name, (least, most, unit) in _ALLOWED.items():
            value = getattr(self, name)
            require(
                value is None or least <= value <= most,
                f"{name} is {value}{unit}; it must lie between {least:g} and {most:g}{unit}",
            )

    def applied_to(self, profile: Profile, reach: float) -> Profile:
        """Return ``profile`` with these overrides and a LiDAR that looks up to ``reach`` far [m].

        Raises:
            ConfigurationError: There is no such footprint, or the LiDAR measures no intensities.
        """
        noise = self.range_noise
        require(
            self.min_intensity is None or profile.lidar.intensities,
            f"min_intensity is {self.min_intensity}, but the LiDAR of the profile {profile.name!r} does not say how "
            "bright its returns are",
        )
        lidar = _given(
            profile.lidar,
            scan=replace(profile.lidar.scan, range_max=reach),
            noise=None if noise is None else constant_noise(noise) if noise > 0 else (),
            dropout=self.dropout,
            period=None if self.scan_rate is None else 1 / self.scan_rate,
            min_intensity=self.min_intensity,
        )
        drive = _given(profile.drive, max_speed=self.speed_limit, max_acceleration=self.acceleration, lag=self.lag)
        in_step = profile.control_period == profile.lidar.period
        return _given(
            profile,
            footprint=None if self.footprint is None else Footprint.parse(self.footprint),
            lidar=lidar,
            drive=drive,
            control_period=lidar.period if in_step else None,
            latency=self.latency,
            odometry=profile.odometry and self.odometry,
        )


def _given(settings: Settings, **values: Any) -> Settings:
    """Return settings with the values that are not ``None`` in place of their own."""
    return replace(settings, **{name: value for name, value in values.items() if value is not None})
