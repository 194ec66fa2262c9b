"""A live team: a simulation at the pace of the clock, which people pause, change, and reach into."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from triform.control import ControllerSpec, decide
from triform.evaluation.scenario import Scenario
from triform.simulation import Footprint, World, world_seeds
from triform.threads import limit_threads
from triform.types import Controller, FloatArray, PrivilegedView, TriformError, convert_fields, require
from triform.viewer.formation import TRAIL, Course, Formation, Picture, between, course_row, earlier_poses, stacked
from triform.viewer.sensing import Sensing, sense

if TYPE_CHECKING:
    from triform.simulators.mujoco import MujocoTeam

#: Plots go back so far [s].
_MEMORY = 60.0
#: A simulation that is later than this gives up catching up [s].
_LATEST = 0.2
SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
#: Distance between robots that are about to leave MuJoCo [m].
_APART = 1000.0
#: A page for more robots is no picture.
MOST_ROBOTS = 300

#: What the team saw last, which body twists its controller wanted, and which it got.
_Seen = tuple[PrivilegedView, FloatArray, FloatArray]


def check_speed(speed: float) -> None:
    """Refuse how many times faster than real nothing is shown.

    Raises:
        ConfigurationError: ``speed`` is not positive, or above the largest of ``SPEEDS``.
    """
    require(0 < speed <= max(SPEEDS), f"speed is {speed:g}; it must be positive and at most {max(SPEEDS):g}")


@dataclass(frozen=True)
class Setup:
    """What team a session has.

    Attributes:
        scenario: Everything about the run but its start and its controller.
        controller: Who steers.
        robots: Number of robots at the start.
        seed: The start is a function of team size and seed.
    """

    scenario: Scenario
    controller: ControllerSpec
    robots: int
    seed: int

    def __post_init__(self) -> None:
        convert_fields(self)
        require(1 <= self.robots <= MOST_ROBOTS, f"robots is {self.robots}; a page shows 1 to {MOST_ROBOTS}")
        require(self.seed >= 0, f"seed is {self.seed}; it must not be negative")
        require(
            self.scenario.simulator != "gazebo" and self.scenario.event is None,
            "a live page has the built-in world or MuJoCo, and events are made by hand: drag, add or remove a robot",
        )

    def changed(self, **changes: Any) -> Setup:
        """Return another setup: fields of this one, of its scenario, or ``range_noise``, in place of its own.

        Raises:
            ConfigurationError: A value is not allowed.
        """
        own = {name: changes.pop(name) for name in ("controller", "robots", "seed") if name in changes}
        scenario = self.scenario
        if "range_noise" in changes:
            noise = changes.pop("range_noise")
            changes["overrides"] = replace(scenario.overrides, range_noise=noise)
        scenario = replace(scenario, **changes)
        if isinstance(own.get("controller"), str):
            own["controller"] = ControllerSpec.parse(own["controller"])
        if scenario.team.robots is not None:
            own["robots"] = scenario.team.robots
        return replace(self, scenario=scenario, **own)


class Session:
    """One team that goes on until it is stopped; every method may be called from any thread.

    A thread of its own simulates. A page asks for a ``picture`` and never waits for a step.
    """

    def __init__(self, setup: Setup, threads: int | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        """Place the team.

        Args:
            setup: The team.
            threads: Threads of the simulation; one for each processor if omitted.
            clock: Tells the time [s].

        Raises:
            TriformError: The controller cannot steer these robots, or the arena has no place for their start.
        """
        self._condition = threading.Condition()
        self._threads, self._clock = threads, clock
        self._paused, self._stopped = False, False
        self._speed = 1.0
        self._problem = ""
        self._sensed: tuple[_Seen, int, Sensing] | None = None
        self._shown: tuple[Formation, FloatArray, float, FloatArray]
        self._thread = threading.Thread(target=self._run, name="triform-session", daemon=True)
        self._begin(setup, setup.scenario.make_controller(setup.controller), self._new_world(setup), 0.0)

    def start(self) -> None:
        """Let the clock run."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        with self._condition:
            self._stopped = True
            self._condition.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def paused(self) -> bool:
        """Whether time stands still."""
        return self._paused

    def pause(self, paused: bool = True) -> None:
        """Let time stand still, or go on."""
        with self._condition:
            self._paused = paused
            self._condition.notify_all()

    def step(self) -> None:
        """Let time stand still after one more control period."""
        with self._condition:
            self.pause()
            self._advance()

    @property
    def speed(self) -> float:
        """How many times faster than real the team is, as far as the computer keeps up."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        check_speed(speed)
        with self._condition:
            self._speed = speed
            self._condition.notify_all()

    def _run(self) -> None:
        """Advance whenever a control period is over, until the session is stopped."""
        due = self._clock()
        with limit_threads(self._threads), self._condition:
            while not self._stopped:
                now = self._clock()
                if self._paused:
                    self._condition.wait()
                    due = self._clock()
                elif now < due:
                    # Whoever changes something wakes this thread, and the time that is left is then another one.
                    self._condition.wait(due - now)
                else:
                    self._advance()
                    due = max(due, now - _LATEST) + self.period / self._speed
                    # Those who want to change something get their turn even if the computer is late.
                    self._condition.wait(1e-4)

    @property
    def setup(self) -> Setup:
        """What the team is now."""
        return self._setup

    @property
    def period(self) -> float:
        """Time between two records [s]."""
        return self._world.control_period

    @property
    def outlines(self) -> Footprint | tuple[Footprint, ...]:
        """Outline of all robots, or of each."""
        return self._setup.scenario.team.outlines(self._world.active.shape[1])

    def picture(self) -> Picture:
        """Return what is to be drawn now: robots glide from one record to the next."""
        formation, earlier, since, trail = self._shown
        share = 1.0 if self._paused else min(1.0, (self._clock() - since) * self._speed / self.period)
        return Picture(formation, between(earlier, formation.poses, share), trail)

    def course(self) -> Course:
        """Return how the last minute went."""
        with self._condition:
            return Course.of(list(self._course))

    def sensing(self, robot: int) -> Sensing | None:
        """Return what a robot sees, and its command; ``None`` if there is no such robot."""
        seen, setup = self._seen, self._setup
        view, wanted, commands = seen
        if not (0 <= robot < view.active.shape[1] and view.active[0, robot]):
            return None
        known = self._sensed
        if known is None or known[0] is not seen or known[1] != robot:
            self._sensed = known = seen, robot, sense(view, wanted, commands, robot, setup.controller, setup.scenario)
        return known[2]

    def problem(self) -> str:
        """Return why the team stopped, once; empty if it did not."""
        with self._condition:
            problem, self._problem = self._problem, ""
            return problem

    def reset(self) -> None:
        """Begin anew from the start."""
        with self._condition:
            self._begin(self._setup, self._controller, self._new_world(self._setup), 0.0)
            self._condition.notify_all()

    def change(self, **changes: Any) -> None:
        """Change the setup: see ``Setup.changed``.

        Another controller, d* or noise finds the robots where they are; all else begins anew.

        Raises:
            TriformError: It is not allowed; the team then goes on as it was.
        """
        with self._condition:
            new = self._setup.changed(**changes)
            if new == self._setup:
                return
            scenario, old = new.scenario, self._setup.scenario
            controller = self._controller
            if (scenario, new.controller) != (old, self._setup.controller):
                controller = scenario.make_controller(new.controller)
            world: World | MujocoTeam
            world, began = self._world, self._began
            if (new.robots, new.seed, scenario.profile, scenario.arena) != (
                self._setup.robots, self._setup.seed, old.profile, old.arena,
            ):  # fmt: skip
                world, began = self._new_world(new), 0.0
            elif scenario != old:
                world, began = self._same_places(new), began + world.time
            self._begin(new, controller, world, began)
            self._condition.notify_all()

    def add(self, x: float, y: float) -> int:
        """Add a robot at a point of the floor [m], and return its index.

        Raises:
            TriformError: There is no place for it.
        """
        with self._condition:
            world = self._world
            require(world.active.sum() < MOST_ROBOTS, f"there are {MOST_ROBOTS} robots; a page shows no more")
            taken = self._taken(x, y, None)
            require(not taken, taken)
            robot = world.add_robot(0, [x, y, 0.0])
            self._publish(held=True)
            return robot

    def remove(self, robot: int) -> None:
        """Take a robot away.

        Raises:
            TriformError: There is no such robot, or it is the last one.
        """
        with self._condition:
            require(self._world.active.sum() > 1, "the last robot stays; without it there is nothing to see")
            self._world.remove_robot(0, robot)
            self._held.discard(robot)
            self._publish(held=True)

    def drag(self, robot: int, x: float, y: float, strictly: bool = True) -> None:
        """Hold a robot above a point of the floor [m] until it is let go; it does not drive meanwhile.

        Args:
            robot: Index of the robot.
            x: Where it shall be [m].
            y: Where it shall be [m].
            strictly: Whether a point without a place for it is refused; otherwise the robot stays where it is.

        Raises:
            TriformError: There is no such robot, or no place for it there.
        """
        with self._condition:
            world = self._world
            if not (0 <= robot < world.active.shape[1] and world.active[0, robot]):
                raise TriformError(f"there is no robot {robot} to drag")
            self._held.add(robot)
            taken = self._taken(x, y, robot)
            require(not (taken and strictly), taken)
            if not taken:
                world.move_robot(0, robot, [x, y, world.poses[0, robot, 2]])
                self._publish(held=True)

    def release(self, robot: int) -> None:
        """Let a robot go that was dragged."""
        with self._condition:
            self._held.discard(robot)

    def _new_world(self, setup: Setup) -> World | MujocoTeam:
        scenario = setup.scenario
        poses = scenario.sample_starts(setup.robots, 1, setup.seed)
        return scenario.make_team(poses, world_seeds(setup.robots, setup.seed, [0]))

    def _same_places(self, setup: Setup) -> World | MujocoTeam:
        """Return another world with the robots at rest where they are."""
        scenario, old = setup.scenario, self._world
        seeds, active = world_seeds(setup.robots, setup.seed, [0]), old.active
        if isinstance(old, World):
            return World(np.nan_to_num(old.poses), scenario.team, scenario.surroundings, seeds, active)
        # Bodies in MuJoCo are solid: those that are to go stand apart until they do.
        apart = np.column_stack([_APART * np.arange(1.0, active.shape[1] + 1), *2 * [np.zeros(active.shape[1])]])
        placed = np.where(active[..., None], old.poses, apart)
        world = type(old)(placed, scenario.robot, scenario.surroundings, seeds, scenario.base)
        for robot in np.flatnonzero(~active[0]).tolist():
            world.remove_robot(0, robot)
        return world

    def _begin(self, setup: Setup, controller: Controller[Any], world: World | MujocoTeam, began: float) -> None:
        """Go on with another world or controller, once it is known that the controller can steer it."""
        view = world.observe()
        wanted, commands = map(np.array, decide(controller, view))
        if began == 0.0 and world.time == 0.0:
            self._course: deque[FloatArray] = deque(maxlen=max(2, round(_MEMORY / world.control_period)))
            self._trail: deque[FloatArray] = deque(maxlen=max(2, round(TRAIL / world.control_period)))
        self._setup, self._controller, self._world, self._began = setup, controller, world, began
        self._held: set[int] = set()
        self._seen: _Seen = view, wanted, commands
        self._sensed = None
        self._publish(held=True)

    def _advance(self) -> None:
        """Simulate one control period; a controller that fails stops the time."""
        world = self._world
        view = world.observe()
        try:
            wanted, commands = map(np.array, decide(self._controller, view))
            commands[0, sorted(self._held)] = 0.0
            world.apply(commands, world.control_period)
        except TriformError as error:
            self._problem, self._paused = str(error), True
            return
        self._seen = view, wanted, commands
        self._publish()

    def _publish(self, held: bool = False) -> None:
        """Show the team as it is, with robots on their way there unless time is ``held``."""
        world = self._world
        poses, active = world.poses[0], world.active[0]
        formation = Formation.of(self._began + world.time, poses, active, self._setup.scenario.distance)
        earlier = formation.poses
        if not held:
            earlier = earlier_poses(self._shown[0], formation)
            self._course.append(course_row(formation))
            self._trail.append(poses[:, :2])
        trail = stacked(list(self._trail), len(active))
        self._shown = formation, earlier, self._clock(), trail

    def _taken(self, x: float, y: float, robot: int | None) -> str:
        """Say why a robot, or a new one, cannot stand at a point; empty if it can."""
        world, outlines = self._world, self.outlines
        others = world.active[0].copy()
        if robot is not None:
            others[robot] = False
        each = [outlines] * len(others) if isinstance(outlines, Footprint) else list(outlines)
        own = world.newcomer.footprint if robot is None else each[robot]
        radii = np.array([each[other].circumradius for other in np.flatnonzero(others)])
        gaps = np.linalg.norm(world.poses[0, others, :2] - [x, y], axis=1) - radii - own.circumradius
        if not (np.isfinite([x, y]).all() and (gaps > 0).all()):
            return f"a robot at {x:.2f}, {y:.2f} m would stand on another one"
        alone = World(np.array([[[x, y, 0.0]]]), replace(world.newcomer, footprint=own), world.arena, [0])
        return f"a robot at {x:.2f}, {y:.2f} m would stand in a wall or pillar" if alone.hit_arena[0] else ""
