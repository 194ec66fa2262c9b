from __future__ import annotations

import os
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.threads import in_parts, limit_threads, usable_threads
from triform.types import ConfigurationError


@settings(deadline=None, max_examples=100)
@given(st.integers(0, 50), st.integers(0, 100), st.integers(1, 8))
def test_the_parts_cover_everything_once_whatever_the_threads(count: int, work: int, threads: int) -> None:
    parts: list[tuple[int, int]] = []
    lock = threading.Lock()

    def kernel(first: int, last: int) -> None:
        with lock:
            parts.append((first, last))

    with limit_threads(threads):
        in_parts(kernel, count, work, 10)
    assert sorted(k for first, last in parts for k in range(first, last)) == list(range(count))
    assert len(parts) <= max(1, min(threads, work // 10))


def test_a_limit_holds_inside_and_in_its_own_thread_only() -> None:
    everywhere = usable_threads()
    seen: list[int] = []
    with limit_threads(everywhere + 3):
        other = threading.Thread(target=lambda: seen.append(usable_threads()))
        other.start()
        other.join()
        assert usable_threads() == everywhere + 3
        with limit_threads(None):
            assert usable_threads() == everywhere + 3
    assert usable_threads() == everywhere
    assert seen == [everywhere]


@pytest.mark.parametrize("bad_part", [0, 1])
def test_an_error_in_any_part_comes_out_after_all_parts_have_ended(bad_part: int) -> None:
    ended: list[int] = []

    def kernel(first: int, last: int) -> None:
        if first == 5 * bad_part:
            raise ValueError(f"part {first}")
        ended.append(first)

    with limit_threads(2), pytest.raises(ValueError, match=f"part {5 * bad_part}"):
        in_parts(kernel, 10, 100, 1)
    assert ended == [5 * (1 - bad_part)]


def test_parts_may_have_parts() -> None:
    done: list[int] = []
    with limit_threads(8):
        in_parts(lambda *_: in_parts(lambda first, last: done.append(last - first), 8, 8, 1), 8, 8, 1)
    assert sum(done) == 64


# Python 3.12 and later warn of every fork of a process with threads, which is what is tested.
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own() -> None:
    done: list[int] = []
    with limit_threads(2):
        in_parts(lambda first, last: done.append(last - first), 4, 100, 1)
        child = os.fork()
        if child == 0:
            in_parts(lambda first, last: done.append(last - first), 4, 100, 1)
            os._exit(0 if sum(done) == 8 else 1)
        assert os.waitpid(child, 0)[1] == 0
    assert sum(done) == 4


def test_no_threads_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="threads is 0"), limit_threads(0):
        pass
