"""The built-in world: robots, their LiDARs and bases, and the place they move in."""

from __future__ import annotations

from triform.geometry.footprint import FOOTPRINTS, ROBOMASTER_EP, Footprint
from triform.simulation.arena import ARENAS, Arena, get_arena
from triform.simulation.arena_file import arena_toml
from triform.simulation.composition import Composition, read_kinds
from triform.simulation.kinematics import integrate, limit_twists, steer
from triform.simulation.lidar import angle_offsets, apply_noise, cast_rolling, cast_scans, cast_world, noise_sigma
from triform.simulation.mounting import Mounting, Placement, read_sectors
from triform.simulation.pace import pace
from triform.simulation.profile_file import profile_toml
from triform.simulation.profiles import (
    HARDWARE,
    IDEAL,
    Drive,
    LidarConfig,
    NoiseBand,
    Profile,
    constant_noise,
)
from triform.simulation.shipped import PROFILES, get_profile
from triform.simulation.simulated import SimulatedTeam
from triform.simulation.spawn_kernels import is_connected
from triform.simulation.spawning import load_starts, sample_addition, sample_starts, world_seeds
from triform.simulation.world import World, make_world

__all__ = [
    "ARENAS",
    "FOOTPRINTS",
    "HARDWARE",
    "IDEAL",
    "PROFILES",
    "ROBOMASTER_EP",
    "Arena",
    "Composition",
    "Drive",
    "Footprint",
    "LidarConfig",
    "Mounting",
    "NoiseBand",
    "Placement",
    "Profile",
    "SimulatedTeam",
    "World",
    "angle_offsets",
    "apply_noise",
    "arena_toml",
    "cast_rolling",
    "cast_scans",
    "cast_world",
    "constant_noise",
    "get_arena",
    "get_profile",
    "integrate",
    "is_connected",
    "limit_twists",
    "load_starts",
    "make_world",
    "noise_sigma",
    "pace",
    "profile_toml",
    "read_kinds",
    "read_sectors",
    "sample_addition",
    "sample_starts",
    "steer",
    "world_seeds",
]
