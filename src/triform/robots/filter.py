"""What stands between the controller of a robot, its scans and its wheels: one rule for all robots."""

from __future__ import annotations

from dataclasses import replace

from triform.control import IntensityThreshold, SafetySettings, reaction_time, rolling_arcs
from triform.simulation import Profile, pace
from triform.types import Controller, TriformError, View


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
        robot.footprint.size,
        reaction=reaction,
        max_speed=drive.max_speed,
        max_axis_speed=drive.max_axis_speed,
        pace=pace(robot),
    )
    if drive.wheels is None:
        return settings
    arcs = rolling_arcs(drive.wheels, period, drive.turning_lag, 0.0 if robot.odometry else reaction)
    return replace(settings, arcs=arcs)


def from_scans_alone(controller: Controller[View], label: str, min_intensity: float | None) -> Controller[View]:
    """Return a controller as a real robot runs it, which has nothing but scans.

    Args:
        controller: Any controller.
        label: What it is called in the error.
        min_intensity: Intensity from which a return is of a robot; ``None`` if all returns count.

    Raises:
        TriformError: It needs true poses.
        ConfigurationError: The threshold is negative or not finite.
    """
    if controller.privileged:
        raise TriformError(
            f"the controller {label!r} needs everybody's true pose, which no real robot knows; "
            "policy, scan-pipeline and scan-triangulating need nothing but scans"
        )
    return controller if min_intensity is None else IntensityThreshold(controller, min_intensity)
