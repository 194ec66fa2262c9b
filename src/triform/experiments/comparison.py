"""Several controllers on the same starts, side by side: ``triform reproduce comparison``."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from triform.control import EXPERTS, make_controller
from triform.evaluation.metrics import RunTable, concatenate
from triform.evaluation.scenario import Scenario
from triform.experiments.evaluate import Evaluation
from triform.experiments.reproduce_config import Contestant, ReproduceConfig
from triform.report.tables import LEGEND, summary_rows
from triform.types import ConfigurationError, TriformError

#: The number of runs is the same everywhere and stands in the text.
_UNSHOWN = ("runs",)


@dataclass
class Comparison:
    """What a comparison found so far.

    Attributes:
        config: What is compared.
        waiting: Controllers that have not finished yet, in order.
        skipped: Names of controllers that are left out, with the reason.
        evaluations: Results of every finished controller, by name.
    """

    config: ReproduceConfig
    waiting: list[Contestant]
    skipped: dict[str, str]
    evaluations: dict[str, Evaluation] = field(default_factory=dict)

    @classmethod
    def begin(cls, config: ReproduceConfig) -> Comparison:
        """Find out which controllers can be made, before any of them is run.

        Raises:
            TriformError: None can, or the weights of one are damaged.
        """
        waiting, skipped = [], {}
        for contestant in config.contestants:
            try:
                make_controller(contestant.controller, config.distance, contestant.weights)
                waiting.append(contestant)
            except ConfigurationError as error:
                skipped[contestant.label] = str(error)
        if not waiting:
            raise TriformError(f"nothing to compare: {'; '.join(skipped.values())}")
        return cls(config, waiting, skipped)

    def finish(self, evaluation: Evaluation) -> None:
        """Note the results of the first controller that was waiting."""
        self.evaluations[self.waiting.pop(0).label] = evaluation

    @property
    def results(self) -> dict[str, list[dict[str, Any]]]:
        """Summaries of every finished controller, one per team size."""
        return {label: evaluation.results for label, evaluation in self.evaluations.items()}

    @property
    def runs(self) -> RunTable:
        """All runs in one table, with a column that names the controller."""
        tables = []
        for label, evaluation in self.evaluations.items():
            runs = evaluation.runs
            tables.append({"controller": np.full(len(runs["run"]), label)} | runs)
        return concatenate(tables)

    @property
    def table(self) -> tuple[list[str], list[list[str]]]:
        """Headings and formatted rows, one per controller and team size."""
        headings, rows = summary_rows([], _UNSHOWN)[0], []
        for label, results in self.results.items():
            rows += [[label, *cells] for cells in summary_rows(results, _UNSHOWN)[1]]
        return ["controller", *headings], rows

    @property
    def text(self) -> str:
        """What is compared, what is missing, and how to read the table."""
        config = self.config
        parts = [
            f"The same {config.runs} random starts per team size for every controller, {config.duration:g} s each, "
            f"profile {config.profile}, arena {config.arena}. Experts see true poses: expert all, expert-sensed those "
            f"within {EXPERTS['expert-sensed'].sensing_range:g} m, expert-odd those within "
            f"{EXPERTS['expert-odd'].sensing_range:g} m. The others see through each robot's own LiDAR."
        ]
        if self.skipped:
            parts.append(f"Left out: {'; '.join(f'{label} ({why})' for label, why in self.skipped.items())}.")
        if self.waiting:
            parts.append(f"Not finished: {', '.join(contestant.label for contestant in self.waiting)}.")
        return " ".join([*parts, LEGEND])

    def as_json(self) -> dict[str, Any]:
        """Return the machine-readable form."""
        left_out = {"controller", "weights"}
        shared = {item.name: getattr(self.config, item.name) for item in fields(Scenario) if item.name not in left_out}
        return {
            "config": shared | {"runs": self.config.runs, "seed": self.config.seed},
            "controllers": [{"name": label} | evaluation.as_json() for label, evaluation in self.evaluations.items()],
            "skipped": self.skipped,
            "waiting": [contestant.label for contestant in self.waiting],
        }
