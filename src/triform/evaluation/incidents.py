"""Runs in which something happens to the team: a robot stands, leaves or is pushed away, or two teams meet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import numpy as np

from triform.evaluation.metrics import RunTable
from triform.evaluation.rollout import Trajectory, rollout
from triform.evaluation.scenario import Scenario, world_seeds
from triform.experiments.dynamic import change_teams
from triform.simulation import SimulatedTeam
from triform.types import SENSING_RANGE, Controller, FloatArray, IntArray, PrivilegedView

Incident = Literal["stuck", "leaves", "meet", "pushed"]
INCIDENTS: tuple[Incident, ...] = get_args(Incident)

#: Sizes of the two teams that meet.
MEETING = (4, 5)
#: How far apart the nearest robots of the two teams start, in units of d*: just within sight.
MEETING_GAP = 1.9
#: How far a robot is pushed, in units of d*.
PUSH_LENGTH = 0.7

#: Keeps the random streams of worlds, of what happens and of meetings apart from all others.
_WORLD_STREAM, _INCIDENT_STREAM, _MEETING_STREAM = 4, 5, 6


def incident_starts(
    incident: Incident | None, scenario: Scenario, robots: int, runs: int, seed: int, first: int = 0
) -> FloatArray:
    """Return random starts of runs in which ``incident`` happens; nothing does if it is ``None``.

    Only two teams that meet start differently: each is a random start of its own size, and they are put side by side,
    in a random direction, such that the nearest robots of the two are 1.9 d* apart.

    Args:
        incident: What happens.
        scenario: Whose prescribed distance decides how far apart robots start.
        robots: Robots in each run.
        runs: How many.
        seed: Seed; a start is a function of incident, team size, seed and index alone.
        first: Index of the first run.

    Returns:
        Poses, shape (runs, robots, 3).
    """
    if incident != "meet":
        return scenario.draw_starts(robots, runs, seed, first)
    those, others = (scenario.draw_starts(size, runs, seed, first) for size in MEETING)
    draws = world_seeds(robots, seed, range(first, first + runs), _MEETING_STREAM)
    gap = MEETING_GAP * scenario.distance
    return np.stack(
        [_side_by_side(those[run], others[run], gap, np.random.default_rng(draw)) for run, draw in enumerate(draws)]
    )


def run_incident(
    scenario: Scenario,
    incident: Incident,
    poses: FloatArray,
    indices: Sequence[int],
    seed: int,
    moment: float,
    controller: Controller[PrivilegedView],
    on_step: Callable[[float], None] | None = None,
) -> tuple[Trajectory, RunTable]:
    """Run teams to which something happens, all at once.

    A robot that is stuck never moves. At ``moment`` one leaves, or is pushed by 0.7 d* away from the team's centre:
    with equal probability any that this takes away from everybody and leaves within 2 d* of somebody, or the outermost
    one if there is none. Who is pushed is at rest, and sees nothing before its next scan.

    Args:
        scenario: Everything else about the runs.
        incident: What happens.
        poses: Starts, shape (B, N, 3).
        indices: Index of every run; a run is a function of incident, team size, seed and index alone.
        seed: Seed of the runs.
        moment: When a robot leaves or is pushed [s].
        controller: The controller.
        on_step: Called with the number of control periods times robots that were just done, for progress.

    Returns:
        The whole trajectories, and one row of measures per run: from ``moment`` to the end if something happens then.

    Raises:
        ConfigurationError: The arena has no place for a start.
    """
    robots = poses.shape[1]
    draws = world_seeds(robots, seed, indices, _INCIDENT_STREAM)

    def act(runs: slice, team: SimulatedTeam, step: Callable[[], None] | None) -> tuple[Trajectory, RunTable]:
        return _run_incident(scenario, incident, team, draws[runs], moment, controller, step)

    return scenario.run_teams(poses, world_seeds(robots, seed, indices, _WORLD_STREAM), act, on_step)


def _run_incident(
    scenario: Scenario,
    incident: Incident,
    team: SimulatedTeam,
    draws: list[np.random.SeedSequence],
    moment: float,
    controller: Controller[PrivilegedView],
    on_step: Callable[[], None] | None,
) -> tuple[Trajectory, RunTable]:
    """Run and measure one batch of worlds, each with a generator for what happens in it."""
    if incident == "stuck":
        robots = team.active.shape[1]
        stuck = np.array([np.random.default_rng(draw).integers(robots) for draw in draws])
        controller = _OneStands(controller, stuck)
    if incident in ("stuck", "meet"):
        trajectory = rollout(team, controller, scenario.duration, on_step)
        return trajectory, scenario.measure(trajectory, team)
    before = rollout(team, controller, moment, on_step)
    if incident == "leaves":
        change_teams(team, "removal", draws)
    else:
        for index, draw in enumerate(draws):
            push_out(team, index, scenario.distance, np.random.default_rng(draw))
    after = rollout(team, controller, scenario.duration - moment, on_step)
    return before.then(after), scenario.measure(after, team)


def push_out(world: SimulatedTeam, index: int, distance: float, rng: np.random.Generator) -> int:
    """Push a robot of world ``index``, which prescribes ``distance``, away from its team's centre, and return which."""
    robots = np.flatnonzero(world.active[index])
    poses = world.poses[index, robots]
    outward = poses[:, :2] - poses[:, :2].mean(axis=0)
    lengths = np.linalg.norm(outward, axis=-1)
    places = poses[:, :2] + PUSH_LENGTH * distance * outward / np.maximum(lengths, np.finfo(float).tiny)[:, None]
    now, then = (np.linalg.norm(each[:, None] - poses[:, :2], axis=-1) for each in (poses[:, :2], places))
    others = ~np.eye(len(robots), dtype=np.bool_)
    away = (then > now).all(axis=1, where=others)
    seen = (then <= SENSING_RANGE * distance).any(axis=1, where=others)
    fit = np.flatnonzero(away & seen)
    chosen = int(rng.choice(fit)) if len(fit) else int(np.argmax(lengths))
    # Its place becomes free and is the only free one, so the robot gets it again.
    world.remove_robot(index, int(robots[chosen]))
    return world.add_robot(index, [*places[chosen], poses[chosen, 2]])


class _OneStands:
    """A controller of teams in each of which one robot does not move."""

    def __init__(self, controller: Controller[PrivilegedView], standing: IntArray) -> None:
        """Take the controller of the others, and who stands in every world, shape (B,)."""
        self._controller = controller
        self._standing = standing

    @property
    def privileged(self) -> bool:
        """As the controller of the others."""
        return self._controller.privileged

    @property
    def description(self) -> dict[str, Any]:
        """As the controller of the others."""
        return self._controller.description

    def command(self, view: PrivilegedView) -> FloatArray:
        """Return body twists, shape (B, N, 3)."""
        commands = np.array(self._controller.command(view))
        commands[np.arange(len(commands)), self._standing] = 0.0
        return commands


def _side_by_side(first: FloatArray, second: FloatArray, gap: float, rng: np.random.Generator) -> FloatArray:
    """Put a team (M, 3) beside another (N, 3), the nearest robots ``gap`` [m] apart, around the origin.

    A random robot of the second moves along a random line through a random one of the first. Of all ways along it at
    which two robots are as far apart as the gap, the longest leaves all others farther apart.
    """
    angle = rng.uniform(-np.pi, np.pi)
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    offset = first[rng.integers(len(first)), :2] - second[rng.integers(len(second)), :2]
    apart = (second[None, :, :2] + offset - first[:, None, :2]).reshape(-1, 2)
    beside = gap**2 - (apart @ across) ** 2
    met = beside >= 0
    way = (np.sqrt(beside[met]) - apart[met] @ along).max()
    both = np.concatenate([first, second])
    both[len(first) :, :2] += offset + way * along
    both[:, :2] -= both[:, :2].mean(axis=0)
    return both
