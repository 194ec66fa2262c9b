from __future__ import annotations

import threading
import time
from functools import partial

import pytest

from triform.training.prefetch import Prefetched
from triform.types import TriformError


def late(number: int) -> int:
    # The earlier of two neighbours takes longer.
    time.sleep(0.002 * (number % 2 == 0))
    return number


@pytest.mark.parametrize("producers", [1, 2, 5])
def test_results_come_in_the_order_of_their_tasks(producers: int) -> None:
    with Prefetched((partial(late, number) for number in range(40)), producers) as results:
        assert list(results) == list(range(40))


def test_tasks_run_side_by_side_and_not_too_far_ahead() -> None:
    started: set[int] = set()
    both = threading.Barrier(2, timeout=10)

    def task(number: int) -> int:
        started.add(number)
        if number < 2:
            both.wait()
        return number

    with Prefetched((partial(task, number) for number in range(1000)), 2) as results:
        assert next(results) == 0
    assert len(started) < 20


def test_an_error_reaches_the_consumer_in_its_place() -> None:
    def fail() -> int:
        raise TriformError("no")

    with Prefetched(iter([lambda: 1, fail, lambda: 3]), 2) as results:
        assert next(results) == 1
        with pytest.raises(TriformError, match="no"):
            next(results)
