"""What one robot sees: its scan in the world, its occupancy map, and what it makes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from triform.control import ControllerSpec, bright_returns, weights_folder
from triform.evaluation.rollout import Trajectory
from triform.geometry import body_to_world
from triform.mixed import MixedView
from triform.perception import occupancy_maps
from triform.policy import PolicySpec, read_spec
from triform.simulation import Arena, Composition, Profile, World
from triform.types import BoolArray, ConfigurationError, FloatArray, MapArray, PrivilegedView, Scan


@dataclass(frozen=True)
class Sensing:
    """What a robot sees, and its command.

    Attributes:
        pose: Where it was when it took its scan [m, m, rad], shape (3,).
        hits: Returns of its LiDAR in the world frame [m], shape (K, 2).
        dim: Which of them are dimmer than the tape of robots, so that its controller does not see them, shape (K,).
        reach: How far its LiDAR looks [m].
        occupancy: Its occupancy map, shape (H, W); ``None`` where the shipped policy can make none of its scans.
        patch: Cells along a side of a patch of the map.
        half_extent: Distance from the robot to the map's edge [m].
        command: Its body twist [m/s, m/s, rad/s], shape (3,).
    """

    pose: FloatArray
    hits: FloatArray
    dim: BoolArray
    reach: float
    occupancy: MapArray | None
    patch: int
    half_extent: float
    command: FloatArray

    @property
    def hits_body(self) -> FloatArray:
        """Returns of its LiDAR in the robot's own frame [m], shape (K, 2)."""
        return body_to_world(self.hits - self.pose[:2], -self.pose[2])


def sense(
    view: PrivilegedView,
    commands: FloatArray,
    robot: int,
    controller: ControllerSpec,
    distance: float,
    min_intensity: float | None = None,
    world: int = 0,
) -> Sensing:
    """Return what one robot sees.

    Args:
        view: What the team sees.
        commands: Its body twists, shape (B, N, 3).
        robot: Index of the robot along axis N.
        controller: Who steers; the map is that of its policy, or of the default one.
        distance: Prescribed neighbour distance d* [m].
        min_intensity: Intensity from which a return is of a robot, if the scans say how bright they are.
        world: Index of the robot's world along axis B.
    """
    part, index = view, robot
    if isinstance(view, MixedView):
        part, index = next(
            (each, robot - own.start)
            for each, own in zip(view.parts, view.robots, strict=True)
            if own.start <= robot < own.stop
        )
    scans = part.scans
    bright = None if scans.intensities is None else scans.intensities[world, index]
    scan = Scan(np.asarray(scans.ranges[world, index], dtype=np.float64), scans.config, bright)
    ranges = scan.ranges
    seen = ranges if min_intensity is None else bright_returns(scan, min_intensity).ranges
    pose = np.array(part.poses[world, index])
    if part.odometry is not None:
        way = part.odometry[world, index]
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
        occupancy, extent = occupancy_maps(Scan(seen, used), config), config.half_extent
    patch = getattr(spec.network, "patch", 0)
    dim = ~np.isfinite(seen[returned])
    return Sensing(pose, hits, dim, scan.config.range_max, occupancy, patch, extent, np.array(commands[world, robot]))


def sense_again(
    trajectory: Trajectory,
    records: Sequence[int],
    robot: int,
    team: Composition,
    arena: Arena,
    controller: ControllerSpec,
    distance: float,
) -> list[Sensing]:
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
    held = np.concatenate([trajectory.commands[0], trajectory.commands[0, -1:]])[chosen]
    active = trajectory.active[0, chosen]
    seeds = np.random.SeedSequence(0).spawn(len(chosen))
    world = World(trajectory.poses[0, chosen], team.changed(_at_once), arena, seeds, active)
    view, least = world.observe(), least_intensity(team, robot, active.shape[1])
    return [sense(view, held, robot, controller, distance, least, each) for each in range(len(chosen))]


def least_intensity(team: Composition, robot: int, robots: int) -> float | None:
    """Return from which intensity one of so many robots takes a return for a robot; ``None`` for any."""
    kinds = zip(team.profiles, team.slices(robots), strict=True)
    return next(profile.lidar.min_intensity for profile, own in kinds if own.start <= robot < own.stop)


def central_robot(trajectory: Trajectory) -> int:
    """Return the robot that ends nearest to the middle of the first run's team, of those that exist throughout."""
    always = np.flatnonzero(trajectory.active[0].all(axis=0))
    last = trajectory.positions[0, -1]
    middle = np.nanmean(last, axis=0)
    return int(always[np.argmin(np.linalg.norm(last[always] - middle, axis=1))])


def _at_once(profile: Profile) -> Profile:
    """Return a robot whose LiDAR measures all rays at once, and is heard at once."""
    return replace(profile, latency=0.0, lidar=replace(profile.lidar, rolling=False))


@lru_cache
def _spec(weights: str | None) -> PolicySpec:
    return read_spec(weights_folder(weights))
