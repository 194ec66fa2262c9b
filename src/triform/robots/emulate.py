"""Robots to drive without robots: real protocols around one built-in world, in real time.

To ``triform drive`` an emulated robot is a serial port and an address, byte for byte as the real ones are.
"""

from __future__ import annotations

import math
import shlex
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from ipaddress import AddressValueError, IPv4Address
from pathlib import Path

import numpy as np

from triform.limits import LARGEST_INDEX, LARGEST_SEED, require_at_most
from triform.robots.ldrobot import LidarEmulator, LidarModel, get_model
from triform.robots.recorder import POSE_COLUMNS, CsvLog
from triform.robots.robomaster import RoboMasterEmulator
from triform.signals import StopSignals
from triform.simulation import (
    HARDWARE,
    Arena,
    LidarConfig,
    Mounting,
    Profile,
    World,
    apply_noise,
    cast_rolling,
    get_arena,
    get_profile,
    sample_starts,
)
from triform.simulation.odometry import relative_poses
from triform.types import SENSING_RANGE, FloatArray, ScanConfig, convert_fields, require

#: Robots and rays move on by so much at a time [s].
STEP = 0.01
#: True poses are recorded every so many steps.
_STEPS_PER_RECORD = 10
#: All turns that are late are in memory [s].
_LATEST = 60
#: More would need more than one processor.
_MOST_ROBOTS = 50


@dataclass(frozen=True)
class EmulateConfig:
    """Settings of emulated robots.

    Attributes:
        robots: Number of robots.
        seed: The start is a function of team size, seed and index alone.
        index: Which start: run ``index`` of an evaluation with the same team size and seed.
        profile: Robot profile, whose footprint, drive and errors of the LiDAR hold: a name or a TOML file. If omitted,
            hardware with the noise of the LiDAR's model. Rays and turns are those of the model in any case.
        arena: Arena: a name or a TOML file.
        distance: Prescribed neighbour distance d* [m]; starts grow with it.
        lidar_model: Kind of LiDAR: ld06, ld19, stl-19p, ld20 or ld14p.
        latency: Time by which everything that a LiDAR sends is late [s]. The default, the serial line and computing
            make up the hardware profile's 0.12 s until a command can use a finished scan.
        address: Loopback address of the first robot's base; the others follow it.
        local_address: Loopback address to drive the first robot from; the others follow it.
        duration: How long to go on [s]; until Ctrl-C if omitted.
        record: CSV file for the true poses; none if omitted.
    """

    robots: int = 4
    seed: int = 7
    index: int = 0
    profile: str | None = None
    arena: str = "open"
    distance: float = 1.0
    lidar_model: str = "ld20"
    latency: float = 0.115
    address: str = "127.0.1.1"
    local_address: str = "127.0.2.1"
    duration: float | None = None
    record: Path | None = None

    def __post_init__(self) -> None:
        convert_fields(self)
        require(1 <= self.robots <= _MOST_ROBOTS, f"robots is {self.robots}; 1 to {_MOST_ROBOTS} can be emulated")
        require(self.seed >= 0, f"seed is {self.seed}; it must not be negative")
        require(self.index >= 0, f"index is {self.index}; it must not be negative")
        require_at_most("seed", self.seed, LARGEST_SEED)
        require_at_most("index", self.index, LARGEST_INDEX)
        require_at_most("latency", self.latency, _LATEST, " s")
        farthest = self.model.range_max / SENSING_RANGE
        require(
            0 < self.distance <= farthest,
            f"distance is {self.distance} m; it must be positive and at most {farthest:g} m",
        )
        require(0 <= self.latency < math.inf, f"latency is {self.latency} s; it must be finite and not negative")
        require(
            self.duration is None or 0 < self.duration < math.inf,
            f"duration is {self.duration} s; it must be positive and finite",
        )

        _ = self.surroundings
        self.kind.require_holonomic("the emulated RoboMaster")
        for name in ("address", "local_address"):
            first = getattr(self, name)
            try:
                loopback = IPv4Address(first).is_loopback
            except AddressValueError:
                loopback = False
            require(loopback, f"{name} is {first}; it must be an address from 127.0.0.1 to 127.255.255.254")

    @property
    def model(self) -> LidarModel:
        """The LiDAR."""
        return get_model(self.lidar_model)

    @property
    def kind(self) -> Profile:
        """The robots."""
        if self.profile is not None:
            return get_profile(self.profile)
        return replace(HARDWARE, lidar=replace(HARDWARE.lidar, noise=self.model.noise))

    @property
    def surroundings(self) -> Arena:
        """The arena."""
        return get_arena(self.arena)

    def base_address(self, robot: int) -> str:
        """Return the address of a robot's base."""
        return str(IPv4Address(self.address) + robot)

    def driver_address(self, robot: int) -> str:
        """Return the address to drive a robot from."""
        return str(IPv4Address(self.local_address) + robot)

    def draw_start(self) -> FloatArray:
        """Return where the robots start, shape (N, 3) [m, m, rad]."""
        return np.asarray(sample_starts(self.robots, 1, self.seed, self.index, distance=self.distance)[0])


class Emulation:
    """A world whose robots are to be reached by their protocols.

    Every sample of a LiDAR is cast at its own moment, while everybody moves, and sent ``latency`` later.
    """

    def __init__(self, config: EmulateConfig) -> None:
        """Place the robots and open their ports.

        Raises:
            TriformError: There is no such arena, or a port cannot be opened.
        """
        model = config.model
        poses = config.draw_start()[None]
        self._profile = config.kind
        mounting = self._profile.mounting
        self._levels = config.surroundings.levels(self._profile.lidar.brightness)
        self._noise, self._eye = replace(self._profile.lidar, scan=model.scan_config()), (mounting.x, mounting.y)
        # The world only moves the robots; its own LiDAR has a single ray, and hardly ever turns.
        blind = LidarConfig(ScanConfig(rays=1), period=1e6)
        self._world = World(
            poses, replace(self._profile, lidar=blind, mounting=Mounting(), time_step=STEP), config.surroundings
        )
        self._latency = config.latency
        self._start = self.poses
        self._past = deque([self._world.poses] * 2, maxlen=round(config.latency / STEP) + 2)
        self._rngs = [
            np.random.default_rng([config.robots, config.seed, config.index, 1, robot])
            for robot in range(config.robots)
        ]
        self.lidars: list[LidarEmulator] = []
        self.bases: list[RoboMasterEmulator] = []
        with ExitStack() as opened:
            for robot, rng in enumerate(self._rngs):
                self.lidars.append(opened.enter_context(LidarEmulator(model, rng, mounting=mounting)))
                self.bases.append(opened.enter_context(RoboMasterEmulator(config.base_address(robot))))
            self._stack = opened.pop_all()

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self._world.time

    @property
    def poses(self) -> FloatArray:
        """True poses, shape (N, 3) [m, m, rad]."""
        return np.asarray(self._world.poses[0])

    @property
    def commands(self) -> FloatArray:
        """Body twists that the bases hold, shape (N, 3) [m/s, m/s, rad/s]."""
        return np.array([base.command for base in self.bases])

    @property
    def world(self) -> World:
        """The world in which the robots drive."""
        return self._world

    def close(self) -> None:
        """Close all ports."""
        self._stack.close()

    def step(self) -> None:
        """Go on by ``STEP``: wheels, telemetry and LiDARs."""
        self._world.apply(self.commands[None], STEP)
        self._past.append(self._world.poses)
        # As the real ones, they count from where they were switched on.
        come = relative_poses(self.poses, self._start, self._world.active[0])
        for base, pose, twist in zip(self.bases, come, self._world.velocities[0], strict=True):
            base.tell(pose, twist)
        if self.time > self._latency:
            self._sense(self.time - self._latency)

    def _sense(self, until: float) -> None:
        """Measure and send the samples that were due by ``until`` [s]."""
        due = [lidar.due(until) for lidar in self.lidars]
        most = max(map(len, due))
        if most == 0:
            return
        rays = replace(self._noise.scan, rays=most)
        offsets = np.zeros((1, len(due), most))
        for robot, angles in enumerate(due):
            offsets[0, robot, : len(angles)] = angles - rays.angles[: len(angles)]
        active = self._world.active
        scene = (self._profile.footprint, self._world.arena, rays, offsets)
        hits = np.empty(offsets.shape, np.int32)
        exact = cast_rolling(self._past[0], self._past[1], active, *scene, eye=self._eye, hits=hits)[0]
        levels = self._levels[hits[0]]
        for lidar, angles, ranges, level, rng in zip(self.lidars, due, exact, levels, self._rngs, strict=True):
            seen = ranges[: len(angles)]
            bright = self._noise.brightness.measure(level[: len(angles)], seen, rng)
            lidar.emit(apply_noise(seen, self._noise, rng), bright)


def drive_command(config: EmulateConfig, emulation: Emulation, robot: int) -> str:
    """Return the command line that drives a robot."""
    x, y, heading = emulation.poses[robot]
    profile = "" if config.profile is None else f"--profile {shlex.quote(config.profile)} "
    return (
        f"triform drive --lidar {emulation.lidars[robot].path} --lidar-model {config.lidar_model} "
        f"--address {config.base_address(robot)} --local-address {config.driver_address(robot)} "
        f"{profile}--distance {config.distance:g} --seed {robot} --robot {robot} "
        f"--start-pose {x:.4f} {y:.4f} {heading:.4f}"
    )


def run_emulate(
    config: EmulateConfig,
    say: Callable[[str], object],
    warn: Callable[[str], None],
    on_record: Callable[[Emulation], None] | None = None,
) -> None:
    """Emulate robots in real time.

    Args:
        config: Which robots, and for how long.
        say: Called with how to drive them and, at the end, how well the clock was kept.
        warn: Called with a sentence if the recording cannot go on.
        on_record: Called ten times a second of the world.

    Raises:
        TriformError: There is no such arena, a port cannot be opened, or the recording cannot be begun.
        SystemExit: A signal ended the run.
    """
    with closing(Emulation(config)) as emulation, ExitStack() as stack:
        # The first steps load compiled kernels, which takes longer than any LiDAR is silent.
        while emulation.time <= config.latency + STEP:
            emulation.step()
        log = None
        if config.record is not None:
            log = stack.enter_context(closing(CsvLog(config.record, POSE_COLUMNS, warn)))
        for robot in range(config.robots):
            say(drive_command(config, emulation, robot))
        duration = config.duration or math.inf
        longest_behind, steps, began = 0.0, 0, time.monotonic() - emulation.time
        try:
            with StopSignals() as signals:
                while emulation.time < duration - STEP / 2:
                    signals.check()
                    if steps % _STEPS_PER_RECORD == 0:
                        if log is not None:
                            for robot, pose in enumerate(emulation.poses):
                                log.write([emulation.time, robot, *pose])
                        if on_record is not None:
                            on_record(emulation)
                    emulation.step()
                    steps += 1
                    ahead = began + emulation.time - time.monotonic()
                    longest_behind = max(longest_behind, -ahead)
                    time.sleep(max(0.0, ahead))
        finally:
            took = time.monotonic() - began
            factor = emulation.time / took
            say(
                f"{emulation.time:.1f} s emulated in {took:.1f} s, at most {1000 * longest_behind:.0f} ms behind: "
                f"real-time factor {factor:.3f}"
            )
