"""Robots for each base of a simulator."""

from __future__ import annotations

from dataclasses import replace

from triform.simulation import Profile
from triform.simulators.chassis import Base


def on_base(profile: Profile, base: Base) -> Profile:
    """The robots of a holonomic profile, on two driven wheels where the base is differential."""
    if base != "differential":
        return profile
    drive = replace(profile.drive, kind="differential", track=0.2, max_turn_rate=2.0, max_axis_speed=float("inf"))
    return replace(profile, drive=drive)
