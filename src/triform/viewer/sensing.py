"""What one robot sees: its scan in the world, its occupancy map, and what it makes of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from triform.control import ControllerSpec, weights_folder
from triform.geometry import body_to_world
from triform.mixed import MixedView
from triform.perception import occupancy_maps
from triform.policy import PolicySpec, read_spec
from triform.types import ConfigurationError, FloatArray, MapArray, PrivilegedView, Scan


@dataclass(frozen=True)
class Sensing:
    """What a robot sees, and its command.

    Attributes:
        pose: Where it was when it took its scan [m, m, rad], shape (3,).
        hits: Returns of its LiDAR in the world frame [m], shape (K, 2).
        reach: How far its LiDAR looks [m].
        occupancy: Its occupancy map, shape (H, W); ``None`` where the shipped policy can make none of its scans.
        patch: Cells along a side of a patch of the map.
        half_extent: Distance from the robot to the map's edge [m].
        command: Its body twist [m/s, m/s, rad/s], shape (3,).
    """

    pose: FloatArray
    hits: FloatArray
    reach: float
    occupancy: MapArray | None
    patch: int
    half_extent: float
    command: FloatArray


def sense(
    view: PrivilegedView, commands: FloatArray, robot: int, controller: ControllerSpec, distance: float
) -> Sensing:
    """Return what one robot of the first world sees.

    Args:
        view: What the team sees.
        commands: Its body twists, shape (B, N, 3).
        robot: Index of the robot along axis N.
        controller: Who steers; the map is that of its policy, or of the default one.
        distance: Prescribed neighbour distance d* [m].
    """
    part, index = view, robot
    if isinstance(view, MixedView):
        part, index = next(
            (each, robot - own.start)
            for each, own in zip(view.parts, view.robots, strict=True)
            if own.start <= robot < own.stop
        )
    scan = part.scans
    ranges = np.asarray(scan.ranges[0, index], dtype=np.float64)
    pose = np.array(part.poses[0, index])
    if part.odometry is not None:
        way = part.odometry[0, index]
        pose[2] -= way[2]
        pose[:2] -= body_to_world(way[None, :2], pose[2])[0]
    returned = np.isfinite(ranges)
    angles, lengths = scan.config.angles[returned], ranges[returned, None]
    hits = pose[:2] + body_to_world(lengths * np.column_stack([np.cos(angles), np.sin(angles)]), pose[2])
    spec = _spec(controller.weights if controller.name == "policy" else None)
    occupancy, extent = None, 0.0
    try:
        used, config = spec.views(scan.config, distance)
    except ConfigurationError:
        pass
    else:
        occupancy, extent = occupancy_maps(Scan(ranges, used), config), config.half_extent
    patch = getattr(spec.network, "patch", 0)
    return Sensing(pose, hits, scan.config.range_max, occupancy, patch, extent, np.array(commands[0, robot]))


@lru_cache
def _spec(weights: str | None) -> PolicySpec:
    return read_spec(weights_folder(weights))
