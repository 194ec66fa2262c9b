"""What an engine is: it does one task with many items and yields the results as they are finished."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import Protocol, TypeVar

ItemIn = TypeVar("ItemIn", contravariant=True)
ResultOut = TypeVar("ResultOut", covariant=True)
Item = TypeVar("Item")
Result = TypeVar("Result")

#: Notes that so much more work is done, in any unit, for progress.
Report = Callable[[float], None]


class Task(Protocol[ItemIn, ResultOut]):
    """What is done with every item. It can be pickled, and its result is a function of the item alone.

    It calls ``report`` often: only there can it be stopped.
    """

    def __call__(self, item: ItemIn, report: Report, /) -> ResultOut:
        """Do one item."""
        ...


class Engine(Protocol):
    """Does a task with many items, many at once."""

    def run(
        self, task: Task[Item, Result], items: Sequence[Item], on_progress: Report | None = None
    ) -> Generator[tuple[int, Result], None, None]:
        """Yield the index of every item and its result, in the order in which they are finished.

        Items are begun in their order. If an item fails, if the caller fails or is interrupted between two results,
        or if the generator is closed, those under way are stopped and the rest is not begun.

        Args:
            task: What to do.
            items: What to do it with.
            on_progress: Called in the caller's thread with what the tasks report.

        Raises:
            Exception: What the task raised.
        """
        ...
