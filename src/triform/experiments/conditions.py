"""The conditions of ``triform conditions``: what is varied, one at a time, and over which values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

from triform.evaluation.incidents import INCIDENTS, MEETING, Incident
from triform.evaluation.metrics import WINDOW
from triform.evaluation.overrides import FOOTPRINTS
from triform.evaluation.scenario import BulkScenario, Scenario
from triform.experiments.dynamic import CHANGE_TIME
from triform.experiments.grid import LARGE_TEAM, LARGE_TEAM_TIME
from triform.report.page import spell_command
from triform.simulation import ARENAS
from triform.types import require

Condition = Literal[
    "range-noise", "dropped-rays", "scan-rate", "latency", "speed", "acceleration", "lag", "footprint", "arena",
    "team-size", "distance", "incident",
]  # fmt: skip
CONDITIONS: tuple[Condition, ...] = get_args(Condition)

#: Said in every command even where they are the defaults, because a reader asks for them first.
_ALWAYS_SAID = {"controller", "runs", "seed"}
_NEVER_SAID = {"engine", "ray_address", "threads", "output"}


@dataclass(frozen=True)
class Sweep:
    """One condition and the values that it takes.

    Attributes:
        title: What is varied.
        unit: Unit of the labels; empty if they have none.
        option: The option of ``Scenario`` that is set, or ``robots`` or ``incident``.
        values: Values of the option, by their labels.
    """

    title: str
    unit: str
    option: str
    values: Mapping[str, Any]

    @property
    def heading(self) -> str:
        """What is varied, with the unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


def _numbers(*values: float, scale: float = 1.0) -> dict[str, float]:
    """Return values by their labels in a unit of which ``scale`` make one."""
    return {f"{value:g}": value / scale for value in values}


SWEEPS: dict[Condition, Sweep] = {
    "range-noise": Sweep("range noise", "cm", "range_noise", _numbers(0, 0.5, 1, 2, 3, 5, scale=100)),
    "dropped-rays": Sweep("dropped rays", "%", "dropout", _numbers(0, 5, 10, 20, 30, scale=100)),
    "scan-rate": Sweep("scan rate", "Hz", "scan_rate", _numbers(2, 5, 10, 20, 50)),
    "latency": Sweep("latency", "s", "latency", _numbers(0, 0.05, 0.1, 0.2, 0.3, 0.5)),
    "speed": Sweep("largest speed", "m/s", "speed_limit", _numbers(0.05, 0.1, 0.2, 0.5, 1)),
    "acceleration": Sweep("largest acceleration", "m/s²", "acceleration", _numbers(0.5, 1, 2, 4)),
    "lag": Sweep("lag of the base", "s", "lag", _numbers(0, 0.05, 0.1, 0.2, 0.3)),
    "footprint": Sweep("footprint", "", "footprint", {name: name for name in FOOTPRINTS}),
    "arena": Sweep("arena", "", "arena", {name: name for name in ARENAS}),
    "team-size": Sweep("robots", "", "robots", {str(size): size for size in (2, 3, 4, 5, 7, 9, 13, 25, 50, 100)}),
    "distance": Sweep("prescribed distance", "m", "distance", _numbers(0.6, 0.8, 1, 1.25, 1.5)),
    "incident": Sweep("incident", "", "incident", {name: name for name in INCIDENTS}),
}


@dataclass(frozen=True)
class ConditionsConfig(BulkScenario):
    """Settings of a sweep over conditions, one at a time around the scenario.

    Attributes:
        which: Overrides to run; results of the others that are in the folder are kept.
        robots: Team sizes under every condition but the team size itself.
        runs: Runs of every value of a condition and team size.
        seed: A run is a function of team size, seed and index alone.
        incident_time: When a robot leaves or is pushed [s].
        failures: How many failed runs to draw at most.
        output: Folder for the results, from which a sweep that was stopped goes on.
    """

    which: tuple[Condition, ...] = CONDITIONS
    robots: tuple[int, ...] = (7, 9)
    runs: int = 100
    seed: int = 7
    incident_time: float = CHANGE_TIME
    failures: int = 8
    output: Path = Path("conditions")

    def __post_init__(self) -> None:
        super().__post_init__()
        require(len(self.which) > 0, "which is empty; at least one condition is needed")
        for condition in self.which:
            require(condition in CONDITIONS, f"there is no condition {condition!r}; there are {', '.join(CONDITIONS)}")
        require(len(self.robots) > 0, "robots is empty; at least one team size is needed")
        for robots in self.robots:
            require(robots >= 2, f"robots is {robots}; a team under these conditions has at least 2 robots")
        require(self.runs >= 1, f"runs is {self.runs}; at least 1 is needed")
        require(self.seed >= 0, f"seed is {self.seed}; it must not be negative")
        require(self.failures >= 0, f"failures is {self.failures}; it must not be negative")
        require(
            "incident" not in self.which or WINDOW <= self.incident_time <= self.duration - WINDOW,
            f"incident_time is {self.incident_time} s; a run of {self.duration} s is measured over {WINDOW:g} s at its "
            f"end, so an incident must come at least {WINDOW:g} s after the start and before the end",
        )

    def command(self, condition: Condition | None = None) -> str:
        """Return the command that runs one condition again, or all that were asked for."""
        config = self if condition is None else replace(self, which=(condition,))
        return spell_command(["triform", "conditions"], config, _ALWAYS_SAID, _NEVER_SAID)


@dataclass(frozen=True)
class Cell:
    """One value of one condition with one team size: what is run many times.

    Attributes:
        condition: What is varied.
        label: Its value, as people read it.
        scenario: Everything about a run but its start.
        robots: Robots at the start.
        incident: What happens during a run; nothing if ``None``.
    """

    condition: Condition
    label: str
    scenario: Scenario
    robots: int
    incident: Incident | None = None

    @property
    def name(self) -> str:
        """How people tell it from the others."""
        if self.condition == "team-size":
            return f"team of {self.robots}"
        sweep = SWEEPS[self.condition]
        return f"{sweep.title} {self.label} {sweep.unit}".rstrip() + f", {self.robots} robots"


def list_cells(config: ConditionsConfig) -> list[Cell]:
    """Return the cells of all conditions, whether they are asked for or not, in the order in which they are shown."""
    base = Scenario(**{field.name: getattr(config, field.name) for field in fields(Scenario)})
    cells = []
    for condition, sweep in SWEEPS.items():
        for label, value in sweep.values.items():
            if condition == "team-size":
                longer = LARGE_TEAM_TIME if value > LARGE_TEAM else 1
                scenario = replace(base, duration=longer * base.duration)
                cells.append(Cell(condition, label, scenario, value))
            elif condition == "incident":
                sizes = (sum(MEETING),) if value == "meet" else config.robots
                cells += [Cell(condition, label, base, robots, value) for robots in sizes]
            else:
                scenario = replace(base, **{sweep.option: value})
                cells += [Cell(condition, label, scenario, robots) for robots in config.robots]
    return cells
