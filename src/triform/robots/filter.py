"""The safety filter of a robot, from its profile: one law for simulated, emulated and real robots."""

from __future__ import annotations

from dataclasses import replace

from triform.control import SafetySettings, reaction_time, rolling_arcs
from triform.simulation import Profile


def safety_settings(robot: Profile, reaction: float | None = None) -> SafetySettings:
    """Return the settings of the safety filter for a robot.

    Args:
        robot: Its profile, with the limits that its base keeps.
        reaction: Greatest age of a measurement that a command still rests on [s]; that of ``reaction_time`` if omitted.

    Raises:
        ConfigurationError: The reaction is not positive.
    """
    drive, lidar, period = robot.drive, robot.lidar, robot.control_period
    if reaction is None:
        reaction = reaction_time(period, lidar.period, robot.latency, lidar.rolling, drive.braking_lag)
    settings = SafetySettings(
        robot.footprint.size, reaction=reaction, max_speed=drive.max_speed, max_axis_speed=drive.max_axis_speed
    )
    if drive.wheels is None:
        return settings
    arcs = rolling_arcs(drive.wheels, period, drive.turning_lag, 0.0 if robot.odometry else reaction)
    return replace(settings, arcs=arcs)
