"""What one robot sees: the returns of its LiDAR in the world, and its occupancy map."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from triform.control import ControllerSpec, bright_returns, view_maps, weights_folder
from triform.evaluation.rollout import Trajectory
from triform.geometry import body_to_world
from triform.mixed import MixedView
from triform.policy import read_spec
from triform.simulation import Arena, Composition, Profile, World
from triform.types import BoolArray, ConfigurationError, FloatArray, MapArray, PrivilegedView, Scan, View


@dataclass(frozen=True, eq=False)
class RobotSight:
    """What a robot sees at one moment.

    Attributes:
        pose: Where it was when it took its scan [m, m, rad], shape (3,).
        hits: Returns of its LiDAR in the world frame [m], shape (K, 2).
        dim: Which of them are dimmer than the tape of robots, so that its controller does not see them, shape (K,).
        reach: How far its LiDAR looks [m].
        occupancy: Its occupancy map, shape (H, W); ``None`` where the shipped policy can make none of its scans.
        patch: Cells along a side of a patch of the map.
        half_extent: Distance from the robot to the map's edge [m].
    """

    pose: FloatArray
    hits: FloatArray
    dim: BoolArray
    reach: float
    occupancy: MapArray | None
    patch: int
    half_extent: float

    @property
    def hits_body(self) -> FloatArray:
        """Returns of its LiDAR in the robot's own frame [m], shape (K, 2)."""
        return body_to_world(self.hits - self.pose[:2], -self.pose[2])


def place_returns(view: PrivilegedView, robot: int, world: int = 0) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Return where the rays of one robot's scan ended.

    Args:
        view: What a team of one kind sees.
        robot: Index of the robot along axis N.
        world: Index of its world along axis B.

    Returns:
        (pose at which it took the scan [m, m, rad], shape (3,); which rays returned, shape (R,); where they ended in
        the world frame [m], shape (R, 2), at the robot for those that did not return).
    """
    ranges = np.asarray(view.scans.ranges[world, robot], dtype=np.float64)
    pose = np.array(view.poses[world, robot])
    if view.odometry is not None:
        way = view.odometry[world, robot]
        pose[2] -= way[2]
        pose[:2] -= body_to_world(way[None, :2], pose[2])[0]
    angles, returned = view.scans.config.angles, np.isfinite(ranges)
    rays = np.where(returned, ranges, 0.0)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return pose, returned, pose[:2] + body_to_world(rays, pose[2])


def sense_again(
    trajectory: Trajectory,
    records: Sequence[int],
    robot: int,
    team: Composition,
    arena: Arena,
    controller: ControllerSpec,
    distance: float,
) -> list[RobotSight]:
    """Return what a robot sees from where it was at records of the first run, whatever moved it.

    Scans are cast anew, all rays at once and without latency, with the errors of the robot's LiDAR.

    Args:
        trajectory: The run.
        records: Its records.
        robot: A robot that exists at all of them.
        team: Kinds of the robots.
        arena: Walls and pillars.
        controller: Who steered; the map is that of its policy, or of the default one.
        distance: Prescribed neighbour distance d* [m].
    """
    chosen = np.asarray(records)
    seeds = np.random.SeedSequence(0).spawn(len(chosen))
    world = World(trajectory.poses[0, chosen], team.changed(_at_once), arena, seeds, trajectory.active[0, chosen])
    view, kind, index = world.observe(), 0, robot
    if isinstance(view, MixedView):
        kind, index = view.part_of(robot)
        view = view.parts[kind]
    scans, threshold = view.scans, team.profiles[kind].lidar.min_intensity
    seen = scans if threshold is None else bright_returns(scans, threshold)
    own = slice(index, index + 1)
    alone = View(Scan(seen.ranges[:, own], seen.config), view.active[:, own], view.time)
    spec = read_spec(weights_folder(controller.weights if controller.name == "policy" else None))
    maps: MapArray | None = None
    extent = 0.0
    with suppress(ConfigurationError):
        maps, config = view_maps(alone, spec, distance)
        extent = config.half_extent
    patch, sights = getattr(spec.network, "patch", 0), []
    for each in range(len(chosen)):
        pose, returned, places = place_returns(view, index, each)
        dim = ~np.isfinite(seen.ranges[each, index, returned])
        occupancy = None if maps is None else maps[each, 0]
        sights.append(RobotSight(pose, places[returned], dim, scans.config.range_max, occupancy, patch, extent))
    return sights


def central_robot(trajectory: Trajectory) -> int:
    """Return the robot that ends nearest to the middle of the first run's team, of those that exist throughout."""
    always = np.flatnonzero(trajectory.active[0].all(axis=0))
    last = trajectory.positions[0, -1]
    middle = np.nanmean(last, axis=0)
    return int(always[np.argmin(np.linalg.norm(last[always] - middle, axis=1))])


def _at_once(profile: Profile) -> Profile:
    """Return a robot whose LiDAR measures all rays at once, and is heard at once."""
    return replace(profile, latency=0.0, lidar=replace(profile.lidar, rolling=False))
