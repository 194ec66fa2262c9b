"""A scenario: everything about a run but its start and its controller."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from triform.control import (
    ControllerSpec,
    IntensityThreshold,
    MixedController,
    OrcaFilter,
    SafetyFilter,
    control_steps,
    make_controller,
)
from triform.evaluation.events import Event, EventRun, run_event
from triform.evaluation.filters import orca_settings, team_settings
from triform.evaluation.metrics import WINDOW, RunTable, concatenate, measure, recovery
from triform.evaluation.overrides import LIDAR_REACH, Overrides
from triform.evaluation.placement import blocked_starts
from triform.evaluation.rollout import Trajectory, rollout
from triform.evaluation.runs import chunks
from triform.kernels import kernels_were_compiled
from triform.limits import require_at_most
from triform.simulation import (
    Arena,
    Composition,
    Profile,
    SimulatedTeam,
    World,
    get_arena,
    read_kinds,
    sample_starts,
    world_seeds,
)
from triform.simulators.chassis import BASES, Base, braked, check_base
from triform.simulators.gazebo import GazeboServer, GazeboTeam
from triform.types import (
    SENSING_RANGE,
    SIGHT,
    BoolArray,
    ConfigurationError,
    Controller,
    FloatArray,
    IntArray,
    convert_fields,
    require,
)

if TYPE_CHECKING:
    from triform.simulators.mujoco import MujocoTeam

SimulatorName = Literal["builtin", "mujoco", "gazebo"]
SIMULATORS: tuple[SimulatorName, ...] = ("builtin", "mujoco", "gazebo")
Guard = Literal["filter", "orca", "none"]
#: What stands between controller and wheels, and how pages say so.
GUARDS: dict[Guard, str] = {
    "filter": "behind the safety filter",
    "orca": "behind ORCA",
    "none": "without the safety filter",
}
#: A million seconds are eleven days.
_LONGEST = 1_000_000
#: Step of Gazebo's physics for each base [s].
GAZEBO_STEPS: dict[Base, float] = {"planar": 0.01, "mecanum": 0.001}
#: Controllers that have a guard already.
_GUARDED = (SafetyFilter, OrcaFilter)


@dataclass(frozen=True)
class Scenario:
    """Everything about a run but its start and its controller.

    Attributes:
        profile: Robot profile: a name or a TOML file. Of a mixed team, each with its number of robots, such as
            turtlebot4:3 hardware:2.
        arena: Arena: a name or a TOML file.
        distance: Prescribed neighbour distance d* [m]. Starts grow with it.
        sight: How far robots look with their LiDARs [d*], which reach 8 m at most; the paper's look 2 d* far.
        duration: Length of every run [s].
        event: What happens during a run: join, leave, push, stuck or meet, with its time, such as join@15.
        guard: What stands between controller and wheels, whoever steers: the safety filter, which keeps robots from
            driving into what their scans show (filter), optimal reciprocal collision avoidance, which sees the true
            poses and velocities of all (orca), or nothing (none).
        simulator: Simulator of the robots' bodies: builtin, or with mass and contacts mujoco, or gazebo for Gazebo 11.
        base: How MuJoCo and Gazebo move a robot: by a force in the plane (planar), or on its wheels, whose physics
            takes longer: four mecanum wheels of a holonomic robot (mecanum), or in MuJoCo two driven wheels and casters
            of a differential one (differential).
        overrides: What replaces values of the profile.
    """

    #: Options that are one text of several words.
    WORDS: ClassVar[tuple[str, ...]] = ("profile",)

    profile: str = "ideal"
    arena: str = "open"
    distance: float = 1.0
    sight: float = SIGHT
    duration: float = 40.0
    event: Event | None = None
    guard: Guard = "filter"
    simulator: SimulatorName = "builtin"
    base: Base = "planar"
    overrides: Overrides = field(default_factory=Overrides)

    def __post_init__(self) -> None:
        convert_fields(self)
        farthest = LIDAR_REACH / SENSING_RANGE
        require(
            0 < self.distance <= farthest,
            f"distance is {self.distance} m; it must be positive and at most {farthest:g} m, because a robot needs 2 "
            f"d* of the {LIDAR_REACH:g} m that a LiDAR reaches",
        )
        require(
            SENSING_RANGE <= self.sight < np.inf,
            f"sight is {self.sight} d*; it must be finite and at least {SENSING_RANGE:g} d*, because starts "
            "connect robots over that distance",
        )
        require(
            WINDOW <= self.duration < np.inf,
            f"duration is {self.duration} s; a run is measured over its last {WINDOW:g} s, so it must be finite and at "
            "least that long",
        )
        require_at_most("duration", self.duration, _LONGEST, " s")
        require(self.simulator in SIMULATORS, f"simulator is {self.simulator!r}; allowed are {', '.join(SIMULATORS)}")
        require(self.guard in tuple(GUARDS), f"guard is {self.guard!r}; allowed are {', '.join(GUARDS)}")
        require(self.base in BASES, f"base is {self.base!r}; allowed are {', '.join(BASES)}")
        require(
            self.base == "planar" or self.simulator != "builtin",
            f"base is {self.base!r}, but the built-in world has no wheels; it goes with simulator mujoco or gazebo",
        )
        event = self.event
        require(
            event is None or not event.interrupts or WINDOW <= event.time <= self.duration - WINDOW,
            f"the event comes at {0.0 if event is None else event.time:g} s; a run of {self.duration:g} s is measured "
            f"over {WINDOW:g} s before the event and at its end, so it must come at least {WINDOW:g} s after the start "
            "and before the end",
        )
        # Looked up once: files may change later, and are not there on the other machines of a cluster.
        team = Composition.parse(self.profile).changed(partial(self.overrides.applied_to, reach=self.reach))
        require(
            not team.is_mixed or self.simulator == "builtin",
            f"simulator is {self.simulator!r}; robots of several profiles drive in the built-in world alone",
        )
        if self.simulator == "gazebo":
            team.profile.require_holonomic("Gazebo")
            require(
                team.profile.lidar.min_intensity is None,
                f"min_intensity is {team.profile.lidar.min_intensity}, but Gazebo's LiDARs say nothing of materials; "
                "it goes with simulator builtin or mujoco",
            )
        if not team.is_mixed:
            check_base(self.base, team.profile)
        object.__setattr__(self, "_team", team)
        object.__setattr__(self, "_arena", get_arena(self.arena))

    @property
    def reach(self) -> float:
        """How far robots look [m]."""
        return min(self.sight * self.distance, LIDAR_REACH)

    @property
    def team(self) -> Composition:
        """The kinds of robots as they run: their profiles with the overrides, looking as far as ``reach``."""
        team: Composition = self.__dict__["_team"]
        return team

    @property
    def robot(self) -> Profile:
        """The robots as they run, of one kind.

        Raises:
            ConfigurationError: They are of several.
        """
        return self.team.profile

    @property
    def of_first_kind(self) -> Scenario:
        """The scenario with robots of the first profile alone, and any number of them."""
        return replace(self, profile=read_kinds(self.profile)[0][0])

    @property
    def driven(self) -> tuple[Profile, ...]:
        """The kinds of robots with what their bases can do; robots with a mass cannot accelerate at will."""
        profiles = self.team.profiles
        if self.simulator == "builtin":
            return profiles
        return tuple(replace(profile, drive=braked(profile.drive)) for profile in profiles)

    @property
    def surroundings(self) -> Arena:
        """The arena."""
        arena: Arena = self.__dict__["_arena"]
        return arena

    @property
    def steps(self) -> int:
        """Control periods in one run."""
        return control_steps(self.duration, self.team.control_period)

    def make_controller(self, controller: Controller[Any] | str | ControllerSpec = "policy") -> Controller[Any]:
        """Make a controller for these robots, behind the ``guard``.

        With a ``min_intensity`` it does not see what is dimmer; the guard does.

        Args:
            controller: The name of one, or one without its guard; one that has a guard already stays as it is.

        Raises:
            ConfigurationError: ORCA does not go with these robots, or is not installed.
            TriformError: There is no such controller, or its weights cannot be used.
        """
        if isinstance(controller, MixedController):
            return controller
        team, first = self.team, self._make_own(controller, self.team.profiles[0])
        everyone = first if team.is_mixed and first.privileged else None
        own = [first] + [everyone or self._make_own(controller, profile) for profile in team.profiles[1:]]
        if self.guard == "orca" and not isinstance(own[0], _GUARDED):
            arena = self.surroundings
            own = [OrcaFilter(own[0], orca_settings(self.driven), arena.walls, arena.pillars)]
        elif self.guard == "filter":
            settings = team_settings(self.driven)
            own = [
                each if isinstance(each, _GUARDED) else SafetyFilter(each, rules)
                for each, rules in zip(own, settings, strict=True)
            ]
        return MixedController(own, everyone) if team.is_mixed else own[0]

    def _make_own(self, controller: Controller[Any] | str | ControllerSpec, profile: Profile) -> Controller[Any]:
        """Make the controller of one kind; of several, each has its own workspace for its own scans."""
        mixed = self.team.is_mixed
        if isinstance(controller, str | ControllerSpec):
            made = make_controller(
                controller,
                self.distance,
                footprint=profile.footprint.size,
                sight=self.sight,
                noise=profile.lidar.largest_noise,
            )
        else:
            made = copy.copy(controller) if mixed else controller
        threshold = profile.lidar.min_intensity
        # One that sees all poses of a mixed team sees no scans.
        sees_scans = not (mixed and made.privileged) and not isinstance(made, (*_GUARDED, IntensityThreshold))
        return IntensityThreshold(made, threshold) if sees_scans and threshold is not None else made

    def sample_starts(self, robots: int, runs: int, seed: int, first: int = 0) -> FloatArray:
        """Return random starts, shape (runs, robots, 3) [m, m, rad]: functions of (robots, seed, index) and event."""
        if self.event is not None:
            return self.event.sample_starts(robots, runs, seed, first, self.distance)
        return sample_starts(robots, runs, seed, first, distance=self.distance)

    def run(
        self,
        poses: FloatArray,
        controller: Controller[Any] | str | ControllerSpec = "policy",
        seed: int = 7,
        indices: Sequence[int] | IntArray | None = None,
        on_step: Callable[[float], None] | None = None,
        scans: bool = False,
    ) -> tuple[Trajectory, RunTable]:
        """Run and measure B worlds.

        Args:
            poses: Starts, shape (B, N, 3) [m, m, rad].
            controller: A controller, or the name of one. The guard of the scenario is put behind it.
            seed: Seed of the runs.
            indices: Index of every run, shape (B,); a run is a function of start, team size, seed and index alone.
                They count from 0 if omitted.
            on_step: Called with the number of control periods times robots that were just done, for progress.
            scans: Whether to record what the robots sense, too.

        Returns:
            What happened, and one row of measures per run: of an event that interrupts the run, from the event on, with
            columns ``robots_before``, ``formed_before``, ``strict_before``, ``recovery_time``, ``strict_recovery_time``
            and ``changed_robot`` besides.

        Raises:
            ConfigurationError: The arena has no place for a start.
            TriformError: The simulator is missing or fails, or the controller does.
        """
        self.team.team_size(poses.shape[1], poses.shape[1])
        driver = self.make_controller(controller)
        robots, event = poses.shape[1], self.event
        numbers = np.arange(len(poses)) if indices is None else np.asarray(indices)
        seeds = world_seeds(robots, seed, numbers, *([] if event is None else [event.world_stream]))
        draws = [] if event is None else event.draws(robots, seed, numbers)
        parts = []
        for runs, team in self._open_teams(poses, seeds):
            step = None if on_step is None else partial(on_step, poses[runs, :, 0].size)
            if event is None:
                whole = rollout(team, driver, self.duration, step, scans)
                parts.append((whole, self.measure(whole, team)))
            else:
                found = run_event(event, team, draws[runs], driver, self.duration, self.distance, step, scans)
                parts.append((found.whole, self._measure_event(event, found, team)))
        trajectories, tables = zip(*parts, strict=True)
        return Trajectory.side_by_side(trajectories), concatenate(tables)

    def warm_up(self, poses: FloatArray, controller: Controller[Any]) -> None:
        """Compile the kernels of a run by a short one, unless they are kept, so that later runs do not wait for it.

        Args:
            poses: Starts, shape (B, N, 3) [m, m, rad].
            controller: Steers; what it remembers afterwards is what it remembered before.
        """
        if self.simulator != "builtin" or kernels_were_compiled():
            return
        period = self.team.control_period
        short = replace(self, duration=math.ceil(WINDOW / period - 1e-9) * period, event=None)
        # An arena may have no place for these starts; the run itself then says so.
        with suppress(ConfigurationError):
            short.run(poses, copy.deepcopy(controller))

    def make_world(self, poses: FloatArray, seeds: list[np.random.SeedSequence]) -> World:
        """Put robots at ``poses`` (B, N, 3) into B built-in worlds with their own noise.

        Raises:
            ConfigurationError: The arena has no place for a start.
        """
        world = World(poses, self.team, self.surroundings, seeds)
        self._refuse_blocked(blocked_starts(world), world.active.shape[1])
        return world

    def make_team(self, poses: FloatArray, seeds: list[np.random.SeedSequence]) -> World | MujocoTeam:
        """Put robots at ``poses`` (B, N, 3) into B built-in worlds, or into MuJoCo's, with their own noise.

        Raises:
            ConfigurationError: The arena has no place for a start.
        """
        if self.simulator == "builtin":
            return self.make_world(poses, seeds)
        from triform.simulators.mujoco import MujocoTeam

        self.check_starts(poses)
        return MujocoTeam(poses, self.robot, self.surroundings, seeds, self.base)

    def check_starts(self, poses: FloatArray) -> None:
        """Make sure that the arena has a place for all starts (runs, N, 3), before the first of them is run.

        Raises:
            ConfigurationError: Robots of a start overlap an obstacle, or stand on both sides of a wall.
        """
        runs, robots = poses.shape[:2]
        arena = self.surroundings
        if len(arena.walls) + len(arena.pillars) == 0:
            return
        blocked = [
            blocked_starts(World(poses[batch], self.team, arena, [0] * (batch.stop - batch.start)))
            for batch in chunks(runs, robots)
        ]
        self._refuse_blocked(np.concatenate(blocked), robots)

    def measure(self, trajectory: Trajectory, team: SimulatedTeam) -> RunTable:
        """Measure every run of a trajectory that ended in ``team``."""
        return measure(
            trajectory,
            self.distance,
            min_distance=team.min_distance,
            collision=team.collided,
            hit_arena=team.hit_arena,
        )

    def _measure_event(self, event: Event, found: EventRun, team: SimulatedTeam) -> RunTable:
        later = self.measure(found.after, team)
        if found.before is None or found.robot is None:
            return later
        earlier = measure(found.before, self.distance)
        return later | {
            "robots_before": earlier["robots"],
            "formed_before": earlier["success"],
            "strict_before": earlier["strict"],
            **recovery(later, event.time),
            "changed_robot": found.robot,
        }

    def _open_teams(
        self, poses: FloatArray, seeds: list[np.random.SeedSequence]
    ) -> Iterator[tuple[slice, SimulatedTeam]]:
        """Yield which of the B runs, and their worlds: all at once or, in Gazebo, one after another."""
        if self.simulator != "gazebo":
            yield slice(0, len(poses)), self.make_team(poses, seeds)
            return
        self.check_starts(poses)
        spare, step = int(self.event is not None and self.event.kind == "join"), GAZEBO_STEPS[self.base]
        robots, base = poses.shape[1], self.base
        with GazeboServer(self.robot, self.surroundings, robots, drive=base, time_step=step, spare=spare) as server:
            for index in range(len(poses)):
                run = slice(index, index + 1)
                yield run, GazeboTeam(server, poses[run], seeds[run])

    def _refuse_blocked(self, blocked: BoolArray, robots: int) -> None:
        require(
            not blocked.any(),
            f"{blocked.sum()} of {len(blocked)} starts of {robots} robots touch an obstacle of the arena "
            f"{self.arena!r} or have robots on both sides of a wall; choose another arena, smaller teams or other "
            "starts",
        )
