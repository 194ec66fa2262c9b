"""Settings of a reproduction, and the command that repeats it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from triform.control import CONTROLLERS, control_steps
from triform.control.registry import DEFAULT_WEIGHTS
from triform.evaluation.metrics import WINDOW
from triform.evaluation.scenario import BulkScenario
from triform.experiments.dynamic import CHANGE_TIME
from triform.report.page import spell_command
from triform.simulation import get_profile
from triform.types import ConfigurationError, require

What = Literal["table1", "fig2", "fig3", "fig4", "fig5", "fig9", "comparison", "all"]
KEYS = ["table1", "fig2", "fig3", "fig4", "fig5", "fig9", "comparison"]

#: The profile of Fig. 9 and of the row in Table I that stand for the paper's real robots.
REAL_PROFILE = "hardware"

#: Said in every command even where they are the defaults, because a reader asks for them first.
_ALWAYS_SAID = {"controller", "runs", "seed"}


@dataclass(frozen=True)
class Contestant:
    """A controller to compare.

    Attributes:
        controller: One of ``triform.control.CONTROLLERS``.
        weights: Weights of a policy; ``None`` for the others.
    """

    controller: str
    weights: str | None = None

    @property
    def label(self) -> str:
        """How it is called on the command line and in results."""
        return self.controller if self.weights is None else f"{self.controller}:{self.weights}"


@dataclass(frozen=True)
class ReproduceConfig(BulkScenario):
    """Settings of a reproduction.

    Attributes:
        what: Which result of the paper, or the comparison of controllers.
        output: Folder for the results and the page that ties them together.
        runs: Runs of each team size, and of each change of a team.
        seed: A start is a function of team size, seed and index alone.
        compare: Controllers of the comparison; policy:NAME is the policy with those weights, and one whose weights
            are not there is left out.
    """

    what: What = "all"
    output: Path = Path("results")
    runs: int = 100
    seed: int = 7
    compare: tuple[str, ...] = (
        "policy:default",
        "policy:paper",
        "expert",
        "expert-sensed",
        "triangulating",
        "scan-pipeline",
        "scan-triangulating",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.what in (*KEYS, "all"), f"what is {self.what!r}; allowed are {', '.join(KEYS)} and all")
        require(self.runs >= 1, f"runs is {self.runs}; at least 1 is needed")
        require(self.seed >= 0, f"seed is {self.seed}; it must not be negative")
        self._check_duration()
        self._check_compare()

    @property
    def own(self) -> Contestant:
        """The controller of everything but the comparison."""
        return self._contestant(self.controller)

    @property
    def contestants(self) -> list[Contestant]:
        """The controllers to compare."""
        return [self._contestant(name) for name in self.compare]

    def command(self, key: str) -> str:
        """Return the command that makes result ``key`` again: every option that matters to it and is no default."""
        return spell_command(["triform", "reproduce", key], self, _ALWAYS_SAID, self._without_effect(key))

    def _without_effect(self, key: str) -> set[str]:
        nowhere = {"what", "engine", "ray_address"}
        if key != "comparison":
            return nowhere | {"compare"}
        return nowhere | ({"controller"} if "policy" in self.compare else {"controller", "weights"})

    def _contestant(self, name: str) -> Contestant:
        controller, _, weights = name.partition(":")
        if controller == "policy":
            return Contestant(controller, weights or self.weights or DEFAULT_WEIGHTS)
        return Contestant(controller, weights or None)

    def _check_duration(self) -> None:
        """Find out now what the last result would stumble over after hours."""
        require(
            self.what not in ("fig5", "all") or self.duration >= CHANGE_TIME + WINDOW,
            f"duration is {self.duration:g} s; {self.what} needs at least {CHANGE_TIME + WINDOW:g} s, "
            f"{WINDOW:g} s to measure after the team changes at {CHANGE_TIME:g} s",
        )
        control_steps(self.duration, self.robot.control_period)
        if self.what in ("table1", "fig9", "all"):
            try:
                control_steps(self.duration, get_profile(REAL_PROFILE).control_period)
            except ConfigurationError as error:
                raise ConfigurationError(f"{self.what} also runs the profile {REAL_PROFILE!r}: {error}") from None

    def _check_compare(self) -> None:
        require(len(self.compare) > 0, "compare is empty; at least one controller is needed")
        for name in self.compare:
            controller, colon, weights = name.partition(":")
            require(
                controller in CONTROLLERS,
                f"there is no controller {controller!r} to compare; there are {', '.join(CONTROLLERS)}",
            )
            require(
                not colon or (controller == "policy" and weights != ""),
                f"cannot compare {name!r}; only a policy has weights, as in policy:default",
            )
        labels = [contestant.label for contestant in self.contestants]
        for label in labels:
            require(labels.count(label) == 1, f"compare names {label} {labels.count(label)} times; once is enough")
