"""What a run is made of: controller, robot profile, arena, distance and duration."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from triform.control import SafetyFilter, SafetySettings, control_steps, make_controller, reaction_time
from triform.engines import Engine, EngineName, check_engine, open_engine
from triform.evaluation.metrics import WINDOW, RunTable, concatenate, measure
from triform.evaluation.overrides import LIDAR_REACH, Overrides
from triform.evaluation.placement import blocked_starts
from triform.evaluation.rollout import Trajectory, rollout
from triform.robots.gazebo import Base, GazeboServer, GazeboTeam, braked
from triform.simulation import Arena, Drive, Profile, SimulatedTeam, World, get_arena, get_profile, sample_starts
from triform.types import SENSING_RANGE, BoolArray, Controller, FloatArray, PrivilegedView, require

#: Robots of one chunk of runs: enough that the fixed cost of a step is small, few enough that the last chunks of an
#: evaluation keep every processor busy. The same on every machine, so that no result can depend on it.
ROBOTS_PER_CHUNK = 256

#: Drives and measures some of many runs, see ``Scenario.run_teams``.
Act = Callable[[slice, SimulatedTeam, Callable[[], None] | None], tuple[Trajectory, RunTable]]
TeamName = Literal["world", "gazebo"]
#: Step of Gazebo's physics for each of them [s].
GAZEBO_STEPS: dict[Base, float] = {"planar": 0.01, "mecanum": 0.001}


@dataclass(frozen=True)
class Scenario:
    """Everything about a run but its start.

    Attributes:
        controller: Name of the controller, one of triform.control.CONTROLLERS: policy, expert, expert-sensed,
            expert-odd, triangulating, scan-pipeline, scan-triangulating or gnn.
        weights: Weights of policy or gnn: a name of shipped ones or a checkpoint; the default ones if omitted.
        team: Which body: world is the built-in one, gazebo is Gazebo 11, see docs/gazebo.md.
        drive: How Gazebo's robots move: by a force in the plane (planar), or on four mecanum wheels (mecanum), whose
            physics takes 1 ms steps and much longer.
        profile: Name of the robot profile: ideal or hardware.
        arena: Name of the arena: open, room-6 or pillars.
        distance: Prescribed neighbour distance d* [m]. A robot sees as far as 2 d*, and starts grow with d*.
        duration: Length of every run [s].
        threads: Threads of the whole command; one for each processor if omitted.
        range_noise: Standard deviation of measured ranges [m]; the profile's errors if omitted.
        dropout: Share of rays that return nothing; the profile's if omitted.
        scan_rate: LiDAR turns, and commands where the profile keeps both in step, per second [Hz]; the profile's if
            omitted.
        latency: Time from a finished scan until a command can use it [s]; the profile's if omitted.
        speed_limit: Largest speed of the base [m/s]; the profile's if omitted.
        acceleration: Largest acceleration of the base [m/s^2]; the profile's if omitted.
        lag: Time constant of the base's lag [s]; the profile's if omitted.
        footprint: Name of the robots' outline: ep, engineer, circle-5, circle-10, circle-15, circle-20 or box-30; the
            profile's if omitted.
        odometry: Whether robots know from their wheels how far they have come since their scans.
        guard: Whether a layer between controller and wheels keeps robots from driving into what their scans show.
    """

    controller: str = "policy"
    weights: str | None = None
    team: TeamName = "world"
    drive: Base = "planar"
    profile: str = "ideal"
    arena: str = "open"
    distance: float = 1.0
    duration: float = 40.0
    threads: int | None = None
    range_noise: float | None = None
    dropout: float | None = None
    scan_rate: float | None = None
    latency: float | None = None
    speed_limit: float | None = None
    acceleration: float | None = None
    lag: float | None = None
    footprint: str | None = None
    odometry: bool = True
    guard: bool = True

    def __post_init__(self) -> None:
        farthest = LIDAR_REACH / SENSING_RANGE
        require(
            0 < self.distance <= farthest,
            f"distance is {self.distance} m; it must be positive and at most {farthest:g} m, because a robot uses 2 d* "
            f"of the {LIDAR_REACH:g} m that a LiDAR reaches",
        )
        require(
            WINDOW <= self.duration < np.inf,
            f"duration is {self.duration} s; a run is measured over its last {WINDOW:g} s, so it must be finite and at "
            "least that long",
        )
        require(self.threads is None or self.threads >= 1, f"threads is {self.threads}; at least 1 is needed")
        require(self.team in ("world", "gazebo"), f"team is {self.team!r}; allowed are world, gazebo")
        require(
            self.drive == "planar" or self.team == "gazebo",
            f"drive is {self.drive!r}, but the built-in world has no wheels; it goes with team gazebo",
        )
        _ = self.conditions

    @property
    def conditions(self) -> Overrides:
        """What replaces the profile's own values."""
        return Overrides(**{field.name: getattr(self, field.name) for field in fields(Overrides)})

    @property
    def robot(self) -> Profile:
        """The robots as they are run: their profile under the scenario's conditions, seeing 2 d* far."""
        robot = self.conditions.applied_to(get_profile(self.profile), self.distance)
        return robot if self.odometry else replace(robot, odometry=False)

    @property
    def base(self) -> Drive:
        """What the robots' base can do; Gazebo's robots cannot accelerate at will."""
        if self.team == "world":
            return self.robot.drive
        return braked(self.robot.drive)

    @property
    def surroundings(self) -> Arena:
        """The arena."""
        return get_arena(self.arena)

    @property
    def steps(self) -> int:
        """Control periods in one run."""
        return control_steps(self.duration, self.robot.control_period)

    def make_controller(self) -> Controller[PrivilegedView]:
        """Make the controller, guarded if so asked.

        Raises:
            TriformError: There is no such controller, or its weights cannot be used.
        """
        controller = self.make_unguarded()
        if not self.guard:
            return controller
        robot, drive, lidar = self.robot, self.base, self.robot.lidar
        # A limit of acceleration counts as the lag with which a robot at full speed brakes on the same way.
        fastest = min(drive.max_speed, drive.max_axis_speed)
        lag = drive.lag + fastest / (2 * drive.max_acceleration)
        reaction = reaction_time(robot.control_period, lidar.period, robot.latency, lidar.rolling, lag)
        limits = {"max_speed": drive.max_speed, "max_axis_speed": drive.max_axis_speed}
        return SafetyFilter(controller, SafetySettings(robot.footprint.size, reaction=reaction, **limits))

    def make_unguarded(self) -> Controller[PrivilegedView]:
        """Make the controller without the layer that guards it.

        Raises:
            TriformError: There is no such controller, or its weights cannot be used.
        """
        return make_controller(self.controller, self.distance, self.weights, footprint=self.robot.footprint.size)

    def draw_starts(self, robots: int, runs: int, seed: int, first: int = 0) -> FloatArray:
        """Return random starts (runs, robots, 3) for the prescribed distance, as ``triform.simulation.starts``."""
        return sample_starts(robots, runs, seed, first, distance=self.distance)

    def open_teams(
        self, poses: FloatArray, seeds: list[np.random.SeedSequence], spare: int = 0
    ) -> Iterator[tuple[slice, SimulatedTeam]]:
        """Put robots into worlds of their own, and give these all at once or, in Gazebo, one after another.

        Args:
            poses: Starts, shape (B, N, 3).
            seeds: One for the noise of every world.
            spare: How many robots may be added to every world.

        Yields:
            Which of the B runs, and their worlds, which end when the next are asked for.

        Raises:
            ConfigurationError: The arena has no place for a start.
            TriformError: Gazebo is missing or fails.
        """
        if self.team == "world":
            yield slice(0, len(poses)), self.make_world(poses, seeds)
            return
        self.check_starts(poses)
        settings: dict[str, Any] = {"drive": self.drive, "time_step": GAZEBO_STEPS[self.drive], "spare": spare}
        with GazeboServer(self.robot, self.surroundings, poses.shape[1], **settings) as server:
            for index in range(len(poses)):
                run = slice(index, index + 1)
                yield run, GazeboTeam(server, poses[run], seeds[run])

    def make_world(self, poses: FloatArray, seeds: list[np.random.SeedSequence]) -> World:
        """Put robots at ``poses`` (B, N, 3) into B built-in worlds with their own noise.

        Raises:
            ConfigurationError: The arena has no place for a start.
        """
        world = World(poses, self.robot, self.surroundings, seeds)
        self._refuse_blocked(blocked_starts(world), world.active.shape[1])
        return world

    def check_starts(self, poses: FloatArray) -> None:
        """Make sure that the arena has a place for all starts (runs, N, 3), before the first of them is run.

        Raises:
            ConfigurationError: Robots of a start overlap a wall or pillar, or stand on both sides of a wall.
        """
        runs, robots = poses.shape[:2]
        arena = self.surroundings
        if len(arena.walls) + len(arena.pillars) == 0:
            return
        blocked = [
            blocked_starts(World(poses[batch], self.robot, arena, [0] * (batch.stop - batch.start)))
            for batch in chunks(runs, robots)
        ]
        self._refuse_blocked(np.concatenate(blocked), robots)

    def _refuse_blocked(self, blocked: BoolArray, robots: int) -> None:
        require(
            not blocked.any(),
            f"{blocked.sum()} of {len(blocked)} starts of {robots} robots touch a wall or pillar of the arena "
            f"{self.arena!r} or have robots on both sides of a wall; choose another arena, smaller teams or other "
            "starts",
        )

    def run(
        self,
        poses: FloatArray,
        seeds: list[np.random.SeedSequence],
        controller: Controller[PrivilegedView] | None = None,
        on_step: Callable[[float], None] | None = None,
    ) -> tuple[Trajectory, RunTable]:
        """Run and measure B worlds.

        Args:
            poses: Starts, shape (B, N, 3).
            seeds: One for the noise of every world.
            controller: The scenario's own if omitted.
            on_step: Called with the number of control periods times robots that were just done, for progress.

        Returns:
            What happened, and one row of measures per run.

        Raises:
            TriformError: As ``open_teams``.
        """
        driver = controller or self.make_controller()

        def act(_: slice, team: SimulatedTeam, step: Callable[[], None] | None) -> tuple[Trajectory, RunTable]:
            trajectory = rollout(team, driver, self.duration, step)
            return trajectory, self.measure(trajectory, team)

        return self.run_teams(poses, seeds, act, on_step)

    def run_teams(
        self,
        poses: FloatArray,
        seeds: list[np.random.SeedSequence],
        act: Act,
        on_step: Callable[[float], None] | None = None,
        spare: int = 0,
    ) -> tuple[Trajectory, RunTable]:
        """Do something with B worlds, and put together what happened.

        Args:
            poses: Starts, shape (B, N, 3).
            seeds: One for the noise of every world.
            act: Drives and measures some of the worlds; called with which of the B runs they are, their team, and what
                is to be called once per control period.
            on_step: Called with the number of control periods times robots that were just done, for progress.
            spare: How many robots may be added to every world.

        Returns:
            What happened, and one row of measures per run.

        Raises:
            TriformError: As ``open_teams``.
        """
        parts = []
        for runs, team in self.open_teams(poses, seeds, spare):
            step = None if on_step is None else partial(on_step, poses[runs, :, 0].size)
            parts.append(act(runs, team, step))
        trajectories, tables = zip(*parts, strict=True)
        return Trajectory.side_by_side(trajectories), concatenate(tables)

    def measure(self, trajectory: Trajectory, world: SimulatedTeam) -> RunTable:
        """Measure every run of a trajectory that ended in ``world``."""
        return measure(
            trajectory,
            self.distance,
            min_distance=world.min_distance,
            collision=world.collided,
            hit_arena=world.hit_arena,
        )


@dataclass(frozen=True)
class BulkScenario(Scenario):
    """A scenario that is run many times.

    Attributes:
        engine: Where: local is this process, ray is Ray, on this machine or a cluster. Results are the same.
        ray_address: Ray cluster to use, host:port or auto; Ray is started on this machine if omitted.
    """

    engine: EngineName = "local"
    ray_address: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_engine(self.engine, self.ray_address)

    def open_engine(self) -> AbstractContextManager[Engine]:
        """Give the engine, for a ``with`` block.

        Raises:
            TriformError: Ray cannot be reached or started.
        """
        return open_engine(self.engine, self.threads, self.ray_address)


def world_seeds(robots: int, seed: int, runs: Iterable[int], purpose: int = 1) -> list[np.random.SeedSequence]:
    """Return one seed per run for its noise; a function of (robots, seed, index) alone, like the starts.

    Args:
        robots: Number of robots N.
        seed: Seed of the whole evaluation.
        runs: Index of every run.
        purpose: Keeps streams for different uses apart; the starts themselves use none.
    """
    return [np.random.SeedSequence([robots, seed, int(index), purpose]) for index in runs]


def chunks(runs: int, robots: int) -> list[slice]:
    """Cut runs of ``robots`` robots each into chunks of nearly one size; a function of the two numbers alone."""
    count = max(1, min(runs, round(runs * robots / ROBOTS_PER_CHUNK)))
    bounds = [runs * chunk // count for chunk in range(count + 1)]
    return [slice(first, last) for first, last in pairwise(bounds)]
