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
from triform.types import Controller, require
from triform.version import __version__

#: Runs of teams with more robots than this last three times as long, because their robots have farther to go.
LARGE_TEAM = 13
LARGE_TEAM_TIME = 3


def for_team(scenario: Scenario, robots: int) -> Scenario:
    """Return a scenario with the duration that a team of ``robots`` gets."""
    return replace(scenario, duration=LARGE_TEAM_TIME * scenario.duration) if robots > LARGE_TEAM else scenario


def check_teams(robots: Sequence[int], runs: int, seed: int, least: int = 1) -> None:
    """Refuse team sizes, runs and seeds that no experiment has.

    Raises:
        ConfigurationError: There is no team size or one below ``least``, no run, or a negative seed.
    """
    require(len(robots) > 0, "robots is empty; at least one team size is needed")
    for size in robots:
        require(size >= least, f"robots is {size}; a team has at least {least} robot{'s' * (least > 1)}")
    require(runs >= 1, f"runs is {runs}; at least 1 is needed")
    require(seed >= 0, f"seed is {seed}; it must not be negative")


def flat(options: Any, without: Collection[str] = ()) -> dict[str, Any]:
    """Return nested options as one flat table of plain values, as the command line spells them.

    A controller becomes ``controller`` and ``weights``, an event its label. Where runs are computed is left out.

    Args:
        options: A dataclass.
        without: Options that are left out too.
    """
    found: dict[str, Any] = {}
    for each in fields(options):
        value = getattr(options, each.name)
        if isinstance(value, ControllerSpec):
            found |= {"controller": value.name, "weights": value.weights}
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
        "profile_description": asdict(scenario.robot),
        "triform": __version__,
    }


def digest(settings: dict[str, Any]) -> str:
    """Return a short name of plain JSON values, which other values do not have."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]
