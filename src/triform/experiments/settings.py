"""What an experiment records of its options, and which team sizes, runs and durations it accepts."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Sequence
from dataclasses import asdict, fields, is_dataclass, replace
from typing import Any

from triform.control import ControllerSpec
from triform.evaluation.events import Event
from triform.evaluation.runs import Execution
from triform.evaluation.scenario import Scenario
from triform.limits import LARGEST_SEED, require_at_most
from triform.report.listener import Listener
from triform.simulation import Composition
from triform.threads import limit_threads, usable_threads
from triform.types import Controller, require
from triform.version import __version__

#: Runs of teams with more robots than this last three times as long, because their robots have farther to go.
LARGE_TEAM = 13
LARGE_TEAM_TIME = 3
#: More would overflow the memory or the patience of every machine.
MOST_RUNS, _MOST_ROBOTS = 1_000_000, 100_000
#: Control periods times robots that one thread simulates per second with a policy; experts are ten times as fast.
_STEPS_PER_SECOND = 5000


def for_team(scenario: Scenario, robots: int) -> Scenario:
    """Return a scenario with the duration that a team of ``robots`` gets."""
    return replace(scenario, duration=LARGE_TEAM_TIME * scenario.duration) if robots > LARGE_TEAM else scenario


def check_teams(robots: Sequence[int], runs: int, seed: int, least: int = 1) -> None:
    """Refuse team sizes, runs and seeds that no experiment has.

    Raises:
        ConfigurationError: There is no team size or one below ``least``, no run, a negative seed, or too many.
    """
    require(len(robots) > 0, "robots is empty; at least one team size is needed")
    for size in robots:
        require(size >= least, f"robots is {size}; a team has at least {least} robot{'s' * (least > 1)}")
        require_at_most("robots", size, _MOST_ROBOTS)
    require(runs >= 1, f"runs is {runs}; at least 1 is needed")
    require_at_most("runs", runs, MOST_RUNS)
    require(seed >= 0, f"seed is {seed}; it must not be negative")
    require_at_most("seed", seed, LARGEST_SEED)


def team_sizes(scenario: Scenario, robots: tuple[int, ...], omitted: tuple[int, ...]) -> tuple[int, ...]:
    """Return the team sizes of an experiment: those asked for, or that of the profiles if they say it.

    Args:
        scenario: The runs.
        robots: What is asked for.
        omitted: What counts as not asked for: the default.

    Raises:
        ConfigurationError: Something else is asked for than the profiles say.
    """
    size = scenario.team.robots
    if size is None:
        return robots
    require(
        robots in (omitted, (size,)),
        f"robots is {' '.join(map(str, robots))}, and the profiles have {size} robots; omit it or make them equal",
    )
    return (size,)


def run_memory(scenario: Scenario, robots: int, runs: int = 1, scans: bool = False) -> float:
    """Return about how much memory runs need that are simulated at once [bytes].

    It is that of the recorded poses and commands, which are measured as a whole, of the scans that are under way to
    the controllers, and of the robots' own state; found from the peaks of runs of 1 to 1,000 robots and 50 to 40,000
    steps.
    """
    kinds = scenario.team.profiles
    # Recorded scans are there twice while they are put together.
    sensed = 8 * max(each.lidar.scan.rays for each in kinds) + 100 if scans else 0
    late = max(each.latency / each.lidar.period * each.lidar.scan.rays for each in kinds)
    return scenario.steps * (1000 + (200.0 + sensed) * robots * runs) + robots * runs * (1e5 + 8 * late)


def warn_of_time(work: float, threads: int | None, listener: Listener, rate: float = _STEPS_PER_SECOND) -> None:
    """Say so if work will take more than a day.

    Args:
        work: Its size: control periods times robots, or in the unit of ``rate``.
        threads: Threads that share it; one for each processor if ``None``.
        listener: Hears the warning.
        rate: What one thread does per second.
    """
    with limit_threads(threads):
        days = work / (rate * usable_threads() * 86400)
        if days > 1:
            listener.say(
                f"warning: this will take about {days:,.0f} days on {usable_threads()} threads; Ctrl-C stops it, and "
                "what is finished is kept"
            )


def flat(options: Any, without: Collection[str] = ()) -> dict[str, Any]:
    """Return nested options as one flat table of plain values, as the command line spells them.

    A controller becomes ``controller``, with the footprint that it names, and ``weights``, an event its label. Where
    runs are computed is left out.

    Args:
        options: A dataclass.
        without: Options that are left out too.
    """
    found: dict[str, Any] = {}
    for each in fields(options):
        value = getattr(options, each.name)
        if isinstance(value, ControllerSpec):
            found |= {"controller": replace(value, weights=None).label, "weights": value.weights}
        elif isinstance(value, Event):
            found[each.name] = value.label
        elif isinstance(value, Execution):
            continue
        elif is_dataclass(value):
            found |= flat(value)
        elif isinstance(value, tuple):
            found[each.name] = [item.label if isinstance(item, ControllerSpec) else item for item in value]
        else:
            found[each.name] = value
    return {name: value for name, value in found.items() if name not in without}


def describe(scenario: Scenario, controller: Controller[Any]) -> dict[str, Any]:
    """Return a scenario and its controller as plain JSON values, with what their names stand for."""
    return flat(scenario) | {
        "controller_description": controller.description,
        "profile_description": _describe_team(scenario.team),
        "triform": __version__,
    }


def _describe_team(team: Composition) -> dict[str, Any] | list[dict[str, Any]]:
    """The profile of all robots, or of several that of each kind with its number of robots."""
    if not team.is_mixed:
        return asdict(team.profile)
    kinds = zip(team.counts or (), team.profiles, strict=True)
    return [{"robots": count, **asdict(profile)} for count, profile in kinds]


def digest(settings: dict[str, Any]) -> str:
    """Return a short name of plain JSON values, which other values do not have."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]
