"""What stands between controllers and wheels of a team: settings of its safety filters, and of ORCA in their place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from triform.control import OrcaSettings, SafetySettings
from triform.robots.filter import safety_settings
from triform.simulation import Profile
from triform.types import require

#: What ORCA's disc is larger than the circle around the footprint [m]: the library computes in single precision.
ORCA_MARGIN = 0.01


def team_settings(profiles: Sequence[Profile]) -> list[SafetySettings]:
    """Return the settings of the safety filter of each kind of robots in a team.

    Each of two robots takes half of what is left between them, and the proof of ``triform.control.safety`` needs one
    ``reaction`` for both: in a mixed team all have that of the slowest. A box on a differential base may turn while
    others see its flat side: all keep away from the circle around it.

    Args:
        profiles: The kinds, with the limits that their bases keep.
    """
    alone = [safety_settings(profile) for profile in profiles]
    slowest = max(settings.reaction for settings in alone)
    corners = [_corner(profile) for profile in profiles]
    return [
        # The filter of a differential base allows for its own corners itself.
        replace(settings, reaction=slowest, min_gap=settings.min_gap + (max(corners) - own))
        for settings, own in zip(alone, corners, strict=True)
    ]


def orca_settings(profiles: Sequence[Profile]) -> OrcaSettings:
    """Return the settings of ORCA for a team.

    Args:
        profiles: The kinds, with the limits that their bases keep.

    Raises:
        ConfigurationError: There are several kinds, the base is differential, or its speed has no limit.
    """
    require(len(profiles) == 1, "guard is 'orca', which steers robots of one profile alone")
    robot, drive = profiles[0], profiles[0].drive
    robot.require_holonomic("guard 'orca'")
    return OrcaSettings(
        robot.footprint.circumradius + ORCA_MARGIN,
        robot.control_period,
        max_speed=drive.max_speed,
        max_axis_speed=drive.max_axis_speed,
    )


def _corner(profile: Profile) -> float:
    """How far the circle in which a robot turns stands out of its outline [m]; 0 for a holonomic one."""
    footprint = profile.footprint
    return (
        footprint.circumradius - min(footprint.half_length, footprint.half_width)
        if profile.drive.is_differential
        else 0.0
    )
