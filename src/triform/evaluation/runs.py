"""Many runs through an engine: cut into chunks, driven side by side, put together again."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from triform.control.registry import WITH_WEIGHTS, weights_folder
from triform.engines import Engine, Report, Task
from triform.evaluation.metrics import RunTable, concatenate
from triform.evaluation.scenario import Scenario, chunks, world_seeds
from triform.policy.checkpoint import ONNX_FILE, SPEC_FILE, WEIGHTS_FILE
from triform.types import Controller, FloatArray, IntArray, PrivilegedView

Item = TypeVar("Item")
Result = TypeVar("Result")


class PicklableController:
    """A controller that can be sent to another machine, where it is made anew.

    It travels as its name and, for a policy, the contents of its files; no path is used there.
    """

    def __init__(self, scenario: Scenario, controller: Controller[PrivilegedView] | None = None) -> None:
        """Take the controller of ``scenario``, which is made if it is not given."""
        self._scenario = scenario
        self.controller = controller or scenario.make_controller()

    def __reduce__(self) -> tuple[Callable[..., PicklableController], tuple[Any, ...]]:
        if self._scenario.controller not in WITH_WEIGHTS:
            return PicklableController, (self._scenario,)
        folder = weights_folder(self._scenario.weights, self._scenario.controller)
        files = {name: (folder / name).read_bytes() for name in (SPEC_FILE, WEIGHTS_FILE, ONNX_FILE)}
        return _unpacked, (self._scenario, files)


def _unpacked(scenario: Scenario, files: dict[str, bytes]) -> PicklableController:
    with tempfile.TemporaryDirectory(prefix="triform-policy-") as folder:
        for name, data in files.items():
            (Path(folder) / name).write_bytes(data)
        return PicklableController(replace(scenario, weights=folder))


@dataclass(frozen=True)
class Chunk:
    """Some runs of one team size.

    Attributes:
        indices: Index of every run, on which its noise depends, shape (B,).
        poses: Starts, shape (B, N, 3).
    """

    indices: IntArray
    poses: FloatArray


@dataclass(frozen=True)
class MeasureRuns:
    """The task of an evaluation: drive the runs of a chunk and measure them; the trajectories are dropped.

    Attributes:
        scenario: What to run.
        seed: Seed of the worlds' noise.
        portable: The controller.
    """

    scenario: Scenario
    seed: int
    portable: PicklableController

    def __call__(self, chunk: Chunk, report: Report) -> RunTable:
        """One row per run; reports robots times control periods."""
        robots = chunk.poses.shape[1]
        seeds = world_seeds(robots, self.seed, chunk.indices)
        _, table = self.scenario.run(chunk.poses, seeds, self.portable.controller, report)
        return {"run": chunk.indices} | table


def measure_groups(
    task: Task[Chunk, RunTable],
    groups: Sequence[Chunk],
    engine: Engine,
    on_progress: Report | None = None,
) -> Iterator[tuple[int, RunTable]]:
    """Drive and measure groups of runs, each of one team size.

    Args:
        task: What is done with a chunk.
        groups: The runs.
        engine: Where it is done.
        on_progress: Called with robots times control periods that were just done.

    Yields:
        The number of every group and its table, one row per run in order, as soon as it is complete.
    """
    parts = [
        [Chunk(group.indices[part], group.poses[part]) for part in chunks(*group.poses.shape[:2])] for group in groups
    ]
    for number, tables in by_group(task, parts, engine, on_progress):
        yield number, concatenate(tables)


def by_group(
    task: Task[Item, Result],
    groups: Sequence[Sequence[Item]],
    engine: Engine,
    on_progress: Report | None = None,
) -> Iterator[tuple[int, list[Result]]]:
    """Do the items of several groups, and yield the number of every group and its results when it is complete."""
    places = [(number, place) for number, group in enumerate(groups) for place in range(len(group))]
    found: list[dict[int, Result]] = [{} for _ in groups]
    with closing(engine.run(task, [groups[number][place] for number, place in places], on_progress)) as results:
        for index, result in results:
            number, place = places[index]
            found[number][place] = result
            if len(found[number]) == len(groups[number]):
                yield number, [found[number].pop(each) for each in range(len(groups[number]))]
