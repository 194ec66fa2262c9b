"""Safety filters of a team: what those of each kind of robots need to know of the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from triform.control import SafetySettings
from triform.robots.filter import safety_settings
from triform.simulation import Profile


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


def _corner(profile: Profile) -> float:
    """How far the circle in which a robot turns stands out of its outline [m]; 0 for a holonomic one."""
    footprint = profile.footprint
    return (
        footprint.circumradius - min(footprint.half_length, footprint.half_width)
        if profile.drive.is_differential
        else 0.0
    )
