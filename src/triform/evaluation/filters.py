"""Safety filters of a team: what each kind of robots needs to know of itself and of the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from triform.control import SafetySettings, reaction_time, rolling_arcs
from triform.simulation import Drive, Footprint, Profile


def safety_settings(profiles: Sequence[Profile], drives: Sequence[Drive]) -> list[SafetySettings]:
    """Return the settings of the safety filter of each kind of robots in a team.

    Each of two robots takes half of what is left between them, and the proof of ``triform.control.safety`` needs one
    ``reaction`` for both: in a mixed team all have that of the slowest. A box on a differential base may turn while
    others see its flat side: all keep away from the circle around it.

    Args:
        profiles: The kinds.
        drives: What the base of each can do.
    """
    reactions = [
        reaction_time(each.control_period, each.lidar.period, each.latency, each.lidar.rolling, drive.braking_lag)
        for each, drive in zip(profiles, drives, strict=True)
    ]
    turning = max(_standing_out(each.footprint) if each.drive.is_differential else 0.0 for each in profiles)
    return [
        _settings(profile, drive, reaction, max(reactions), turning)
        for profile, drive, reaction in zip(profiles, drives, reactions, strict=True)
    ]


def _settings(profile: Profile, drive: Drive, own: float, slowest: float, turning: float) -> SafetySettings:
    """Settings of one kind with its ``own`` reaction [s], in a team with robots whose corners stand out [m]."""
    settings = SafetySettings(
        profile.footprint.size, reaction=slowest, max_speed=drive.max_speed, max_axis_speed=drive.max_axis_speed
    )
    wheels = drive.wheels
    # The filter of a differential base allows for its own corners itself.
    allowed = _standing_out(profile.footprint) if wheels is not None else 0.0
    settings = replace(settings, min_gap=settings.min_gap + max(turning - allowed, 0.0))
    if wheels is None:
        return settings
    arcs = rolling_arcs(wheels, profile.control_period, drive.turning_lag, 0.0 if profile.odometry else own)
    return replace(settings, arcs=arcs)


def _standing_out(footprint: Footprint) -> float:
    """How far the circle around an outline stands out of it [m]."""
    return footprint.circumradius - min(footprint.half_length, footprint.half_width)
