"""Many runs: where they are computed, and the chunks in which an engine does them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

from triform.engines import Engine, EngineName, Report, Task, check_engine, open_engine
from triform.limits import check_threads, require_memory
from triform.threads import limit_threads, usable_threads
from triform.types import convert_fields

Item = TypeVar("Item")
Result = TypeVar("Result")
Taken = TypeVar("Taken")

#: Robots of one chunk of runs: enough that the fixed cost of a step is small, few enough that the last chunks of an
#: evaluation keep every processor busy. The same on every machine, so that no result can depend on it.
ROBOTS_PER_CHUNK = 256


@dataclass(frozen=True)
class Execution:
    """Where runs are computed; results are the same to the bit everywhere.

    Attributes:
        threads: Threads of the whole command; one for each processor if omitted.
        engine: Engine of the runs: local is this process, ray is Ray, on this machine or a cluster.
        ray_address: Ray cluster to use, host:port or auto; Ray is started on this machine if omitted.
    """

    threads: int | None = None
    engine: EngineName = "local"
    ray_address: str | None = None

    def __post_init__(self) -> None:
        convert_fields(self)
        check_threads(self.threads)
        check_engine(self.engine, self.ray_address)

    def require_memory(self, needed: float) -> None:
        """Refuse runs of which the threads of this machine hold more at once than fits its memory.

        Args:
            needed: About what one thread holds [bytes].

        Raises:
            ConfigurationError: It does not fit.
        """
        if self.engine == "local":
            with limit_threads(self.threads):
                threads = usable_threads()
            require_memory(threads * needed, f"the runs of {threads} threads at once (option threads)")

    def open_engine(self) -> AbstractContextManager[Engine]:
        """Return the engine, for a ``with`` block.

        Raises:
            TriformError: Ray cannot be reached or started.
        """
        return open_engine(self.engine, self.threads, self.ray_address)


def chunks(runs: int, robots: int) -> list[slice]:
    """Cut runs of ``robots`` robots each into chunks of nearly one size; a function of the two numbers alone."""
    count = max(1, min(runs, round(runs * robots / ROBOTS_PER_CHUNK)))
    bounds = [runs * chunk // count for chunk in range(count + 1)]
    return [slice(first, last) for first, last in pairwise(bounds)]


def by_group(
    task: Task[Item, Result],
    groups: Sequence[Sequence[Item]],
    engine: Engine,
    take: Callable[[int, Result], Taken],
    on_progress: Report | None = None,
) -> Iterator[tuple[int, list[Taken]]]:
    """Do the items of several groups, and yield the number of every group and what was taken when it is complete.

    Args:
        task: What to do.
        groups: What to do it with.
        engine: Where.
        take: Called with every result, as it is finished, and its number among the items of all groups; returns what
            is taken of it.
        on_progress: Called with what the tasks report.
    """
    places = [(number, place) for number, group in enumerate(groups) for place in range(len(group))]
    found: list[dict[int, Taken]] = [{} for _ in groups]
    with closing(engine.run(task, [groups[number][place] for number, place in places], on_progress)) as results:
        for index, result in results:
            number, place = places[index]
            found[number][place] = take(index, result)
            if len(found[number]) == len(groups[number]):
                yield number, [found[number].pop(each) for each in range(len(groups[number]))]
