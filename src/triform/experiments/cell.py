"""A cell of a grid: one controller with one team size in one scenario, run many times."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from triform.control import ControllerSpec, control_steps
from triform.engines import Report
from triform.evaluation.metrics import RunTable
from triform.evaluation.rollout import Trajectory
from triform.evaluation.runs import chunks
from triform.evaluation.scenario import Scenario
from triform.experiments.settings import describe, run_memory
from triform.limits import require_memory
from triform.report.output import plain
from triform.types import Controller, FloatArray, IntArray
from triform.version import __version__


@dataclass(frozen=True)
class Starts:
    """Explicit starts of one team size.

    Attributes:
        indices: Index of every run, on which its noise depends, shape (B,).
        poses: Starts, shape (B, N, 3) [m, m, rad].
    """

    indices: IntArray
    poses: FloatArray


@dataclass(frozen=True, eq=False)
class Cell:
    """One controller with one team size in one scenario: what is run many times.

    Attributes:
        labels: What tells the cell from others in a table, by column.
        scenario: Everything about a run but its start and controller.
        controller: Who steers: the name of a controller, or a controller.
        robots: Robots at the start.
        runs: Number of runs.
        seed: A run is a function of scenario, team size, seed and index alone.
        name: How people tell the cell from others.
        group: Cells of a group are left out together, if the controller of one of them cannot be made.
        starts: Explicit starts instead of random ones.
        wanted: Whether the cell is to be run; if not, only results that the file holds are shown.
        scans: Whether what happened in its runs says what the robots sensed.
    """

    labels: Mapping[str, str]
    scenario: Scenario
    controller: ControllerSpec | Controller[Any]
    robots: int
    runs: int
    seed: int
    name: str
    group: str
    starts: Starts | None = None
    wanted: bool = True
    scans: bool = False

    @property
    def key(self) -> tuple[str | int, ...]:
        """Values of the labels, and the team size."""
        return (*self.labels.values(), self.robots)

    @property
    def starts_key(self) -> tuple[Any, ...]:
        """What decides where a run of each index starts: equal for cells that start the same."""
        event = self.scenario.event
        meeting = event is not None and event.kind == "meet"
        return self.robots, self.scenario.distance, self.seed, meeting, self._starts_digest

    @property
    def _starts_digest(self) -> str | None:
        """A digest of the explicit starts; ``None`` if they are random."""
        if self.starts is None:
            return None
        return hashlib.sha256(np.ascontiguousarray(self.starts.poses).tobytes()).hexdigest()

    @property
    def work(self) -> int:
        """Robots times control periods of all runs."""
        return self.scenario.steps * self.runs * self.robots

    @property
    def memory(self) -> float:
        """About how much memory the starts, the measures and the runs of one chunk need [bytes]."""
        largest = max(part.stop - part.start for part in chunks(self.runs, self.robots))
        return run_memory(self.scenario, self.robots, largest, self.scans) + self.runs * (500 + 50 * self.robots)

    def settings(self, controller: Controller[Any]) -> dict[str, Any]:
        """Return all that decides about the runs as plain JSON values, equal for cells that run the same."""
        scenario = self.scenario
        described = describe(scenario, controller)
        chosen = ("controller_description", "profile_description", "arena", "distance", "duration")
        settings: dict[str, Any] = {name: described[name] for name in chosen}
        settings |= {"robots": self.robots, "runs": self.runs, "seed": self.seed, "triform": __version__}
        if scenario.simulator != "builtin":
            settings |= {"team": scenario.simulator, "drive": scenario.base}
        if scenario.event is not None:
            settings |= {"event": asdict(scenario.event)}
        if self.starts is not None:
            settings |= {"starts": self._starts_digest}
        plainly: dict[str, Any] = plain(settings)
        return plainly

    def run(
        self, first: int, count: int, controller: Controller[Any], on_step: Report | None = None
    ) -> tuple[Trajectory, RunTable]:
        """Run ``count`` runs from number ``first`` on, all at once; return what happened, and one row per run."""
        if self.starts is None:
            indices = np.arange(first, first + count)
            poses = self.scenario.sample_starts(self.robots, count, self.seed, first)
        else:
            some = slice(first, first + count)
            indices, poses = self.starts.indices[some], self.starts.poses[some]
        trajectory, table = self.scenario.run(poses, controller, self.seed, indices, on_step, self.scans)
        return trajectory, {"run": indices} | table

    def check(self) -> None:
        """Find out now what a run would stumble over after hours.

        Raises:
            ConfigurationError: A time is no whole number of control periods, the arena has no place for a start, or
                the memory none for a chunk of runs.
        """
        scenario, period = self.scenario, self.scenario.team.control_period
        scenario.team.team_size(self.robots, self.robots)
        control_steps(scenario.duration, period)
        if scenario.event is not None and scenario.event.interrupts:
            control_steps(scenario.event.time, period)
        require_memory(self.memory, f"{self.name}, {scenario.duration:g} s")
        if self.starts is not None:
            scenario.check_starts(self.starts.poses)
        elif scenario.arena != "open":
            scenario.check_starts(scenario.sample_starts(self.robots, self.runs, self.seed))
