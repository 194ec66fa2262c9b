"""Events during a run: a robot joins, leaves, is pushed or stuck, or two teams meet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from triform.evaluation.placement import sample_clear_addition
from triform.evaluation.rollout import Trajectory, rollout
from triform.simulation import SimulatedTeam, sample_starts, world_seeds
from triform.types import (
    SENSING_RANGE,
    ConfigurationError,
    Controller,
    FloatArray,
    IntArray,
    PrivilegedView,
    convert_fields,
    require,
)

EventKind = Literal["join", "leave", "push", "stuck", "meet"]
EVENTS: tuple[EventKind, ...] = get_args(EventKind)

#: When the team of the paper's Fig. 5 changes [s].
EVENT_TIME = 21.0
#: Sizes of the two teams that meet.
MEETING = (4, 5)
#: Distance between the nearest robots of the two teams at the start, in units of d*: just within sight.
MEETING_GAP = 1.9
#: Length of a push, in units of d*.
PUSH_LENGTH = 0.7

#: Random streams of the worlds and of the events.
_STREAMS: dict[EventKind, tuple[int, int]] = dict.fromkeys(EVENTS, (4, 5)) | {"join": (2, 3), "leave": (2, 3)}
_MEETING_STREAM = 6


@dataclass(frozen=True)
class Event:
    """What happens to the team of a run, and when.

    Attributes:
        kind: ``join``: a robot appears, at least 0.5 d* (and 0.5 m) from all others, within 2 d* of one and in the same
            room. ``leave``: any robot disappears. ``push``: a robot is displaced by 0.7 d* away from the team's centre.
            ``stuck``: one robot never moves. ``meet``: teams of 4 and 5 start 1.9 d* apart.
        time: When a robot joins, leaves or is pushed [s].
    """

    kind: EventKind
    time: float = EVENT_TIME

    def __post_init__(self) -> None:
        convert_fields(self)
        require(self.kind in EVENTS, f"event is {self.kind!r}; allowed are {', '.join(EVENTS)}")
        require(0 < self.time < np.inf, f"event time is {self.time} s; it must be positive and finite")

    @classmethod
    def parse(cls, text: str) -> Event:
        """Read ``KIND`` or ``KIND@SECONDS``, such as ``join@15``.

        Raises:
            ConfigurationError: The text says something else.
        """
        kind, at, seconds = text.partition("@")
        event = cls(kind)  # type: ignore[arg-type]
        if not at:
            return event
        try:
            time = float(seconds)
        except ValueError:
            raise ConfigurationError(
                f"event {text!r} has no time after the @; write seconds, as in {kind}@15"
            ) from None
        return replace(event, time=time)

    @property
    def label(self) -> str:
        """The event as ``parse`` reads it."""
        return f"{self.kind}@{self.time:g}" if self.interrupts and self.time != EVENT_TIME else self.kind

    @property
    def interrupts(self) -> bool:
        """Whether the event comes at a moment of the run, which cuts it into a part before and a part after."""
        return self.kind in ("join", "leave", "push")

    @property
    def world_stream(self) -> int:
        """Random stream of the worlds' noise."""
        return _STREAMS[self.kind][0]

    def draws(self, robots: int, seed: int, indices: IntArray) -> list[np.random.SeedSequence]:
        """Return one seed per run for what happens; a function of (robots, seed, index) alone."""
        return world_seeds(robots, seed, indices, _STREAMS[self.kind][1])

    def sample_starts(self, robots: int, runs: int, seed: int, first: int, distance: float) -> FloatArray:
        """Return random starts, shape (runs, robots, 3) [m, m, rad].

        Teams that meet are random starts of their own sizes, placed side by side in a random direction such that the
        nearest robots of the two are 1.9 d* apart. The other events leave starts as they are.

        Args:
            robots: Robots in each run.
            runs: Number of runs.
            seed: Seed; a start is a function of event, team size, seed and index alone.
            first: Index of the first run.
            distance: Prescribed neighbour distance d* [m].

        Raises:
            ConfigurationError: Teams that meet have 9 robots together.
        """
        if self.kind != "meet":
            return sample_starts(robots, runs, seed, first, distance=distance)
        require(
            robots == sum(MEETING),
            f"robots is {robots}; the event meet has teams of {MEETING[0]} and {MEETING[1]}, {sum(MEETING)} robots",
        )
        those, others = (sample_starts(size, runs, seed, first, distance=distance) for size in MEETING)
        draws = world_seeds(robots, seed, range(first, first + runs), _MEETING_STREAM)
        gap = MEETING_GAP * distance
        return np.stack(
            [_side_by_side(those[run], others[run], gap, np.random.default_rng(draw)) for run, draw in enumerate(draws)]
        )


@dataclass(frozen=True)
class EventRun:
    """Runs with an event.

    Attributes:
        whole: The whole runs; the record at the event's time shows the team after it.
        before: The part before the event; ``None`` for an event that lasts the whole run.
        after: What is measured: the part from the event on.
        robot: The robot that joined, left, was pushed or is stuck, shape (B,); ``None`` where teams meet.
    """

    whole: Trajectory
    before: Trajectory | None
    after: Trajectory
    robot: IntArray | None


def run_event(
    event: Event,
    team: SimulatedTeam,
    draws: list[np.random.SeedSequence],
    controller: Controller[PrivilegedView],
    duration: float,
    distance: float,
    on_step: Callable[[], None] | None = None,
    scans: bool = False,
) -> EventRun:
    """Drive B worlds through an event.

    Args:
        event: What happens.
        team: The worlds at their starts.
        draws: Seed of the event in every world.
        controller: Steers the robots.
        duration: Length of a run [s].
        distance: Prescribed neighbour distance d* [m].
        on_step: Called once per control period, for progress.
        scans: Whether to record what the robots sense, too.

    Raises:
        TriformError: The arena has no place for a robot that joins.
    """
    if not event.interrupts:
        stuck = None
        if event.kind == "stuck":
            robots = team.active.shape[1]
            stuck = np.array([np.random.default_rng(draw).integers(robots) for draw in draws])
            controller = _OneStuck(controller, stuck)
        run = rollout(team, controller, duration, on_step, scans)
        return EventRun(run, None, run, stuck)
    before = rollout(team, controller, event.time, on_step, scans)
    robot = interrupt(event, team, draws, distance)
    after = rollout(team, controller, duration - event.time, on_step, scans)
    return EventRun(before.then(after), before, after, robot)


def interrupt(event: Event, team: SimulatedTeam, draws: list[np.random.SeedSequence], distance: float) -> IntArray:
    """Let a robot of every world join, leave or be pushed, and return its index along axis N, shape (B,)."""
    changed = np.empty(len(draws), dtype=np.int64)
    for index, draw in enumerate(draws):
        rng = np.random.default_rng(draw)
        if event.kind == "join":
            changed[index] = team.add_robot(index, sample_clear_addition(team, index, rng, distance))
        elif event.kind == "leave":
            changed[index] = rng.choice(np.flatnonzero(team.active[index]))
            team.remove_robot(index, int(changed[index]))
        else:
            changed[index] = push_out(team, index, distance, rng)
    return changed


def push_out(team: SimulatedTeam, index: int, distance: float, rng: np.random.Generator) -> int:
    """Push a robot of one world by 0.7 d* away from the centre of its team.

    Any robot qualifies, with equal probability, whose push takes it away from all others and leaves it within 2 d* of
    one; if none does, the outermost robot is pushed. The robot is then at rest and sees nothing before its next scan.

    Args:
        team: The worlds.
        index: Which world.
        distance: Prescribed neighbour distance d* [m].
        rng: Source of randomness.

    Returns:
        Index of the robot along axis N.
    """
    robots = np.flatnonzero(team.active[index])
    poses = team.poses[index, robots]
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
    team.remove_robot(index, int(robots[chosen]))
    return team.add_robot(index, [*places[chosen], poses[chosen, 2]])


class _OneStuck:
    """A controller of teams in each of which one robot does not move."""

    def __init__(self, controller: Controller[PrivilegedView], stuck: IntArray) -> None:
        """Take the controller of the others, and the robot that is stuck in every world, shape (B,)."""
        self._controller = controller
        self._stuck = stuck

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
        commands[np.arange(len(commands)), self._stuck] = 0.0
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
