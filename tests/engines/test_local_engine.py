from __future__ import annotations

import threading

import pytest

from triform.engines import LocalEngine, open_engine
from triform.engines.identity import differences, identity
from triform.threads import limit_threads, usable_threads
from triform.types import ConfigurationError, TriformError


def square(item, report):
    report(item)
    return item * item


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_every_item_is_done_once_and_reported_in_the_callers_thread(threads):
    reported, callers = [], set()

    def note(amount):
        reported.append(amount)
        callers.add(threading.get_ident())

    found = dict(LocalEngine(threads).run(square, list(range(40)), note))
    assert found == {item: item * item for item in range(40)}
    assert sorted(reported) == list(range(40))
    assert callers == {threading.get_ident()}


def test_no_items_are_done_at_once():
    assert list(LocalEngine().run(square, [])) == []


def test_results_wait_to_be_taken_and_do_not_pile_up():
    begun = []

    def count(item, report):
        begun.append(item)

    running = LocalEngine(2).run(count, list(range(100)))
    for _ in range(3):
        next(running)
    assert len(begun) <= 3 + 2 * 2
    running.close()
    assert len(begun) <= 3 + 2 * 2


@pytest.mark.parametrize("error", [TriformError("no"), KeyboardInterrupt(), ZeroDivisionError()])
def test_an_error_stops_the_items_under_way_and_begins_no_others(error):
    begun, other_begun = [], threading.Event()

    def fail(item, report):
        begun.append(item)
        if item == 0:
            other_begun.wait()
            raise error
        other_begun.set()
        while True:
            report(0)

    with pytest.raises(type(error)):
        list(LocalEngine(2).run(fail, list(range(50))))
    assert sorted(begun) == [0, 1]


def test_an_interruption_of_the_caller_stops_the_items_under_way():
    stopped = threading.Event()

    def endless(item, report):
        try:
            while True:
                report(1)
        finally:
            stopped.set()

    def interrupt(amount):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(LocalEngine(1).run(endless, [0], interrupt))
    assert stopped.is_set()


@pytest.mark.parametrize(("items", "each"), [(1, 8), (2, 4), (3, 2), (8, 1), (9, 1)])
def test_threads_left_over_go_to_the_items(items, each):
    together = threading.Barrier(min(items, 8))

    def threads(item, report):
        if item < 8:
            together.wait()
        return usable_threads()

    found = dict(LocalEngine(8).run(threads, list(range(items))))
    assert {found[item] for item in range(min(items, 8))} == {each}


def test_an_engine_without_a_number_takes_what_its_caller_may_use():
    seen = []
    with limit_threads(3):
        list(LocalEngine().run(lambda item, report: seen.append(usable_threads()), [0]))
    assert seen == [3]


def test_bad_settings_are_refused():
    with pytest.raises(ConfigurationError, match="0 workers"):
        LocalEngine(0)
    with pytest.raises(ConfigurationError, match="no engine 'steam'"), open_engine("steam"):
        pass
    with pytest.raises(ConfigurationError, match="ray_address is auto, but the engine is local"):
        open_engine("local", address="auto").__enter__()


def test_what_differs_between_machines_is_named():
    here = identity()
    assert {"triform", "numpy", "numba", "onnxruntime", "sources of triform"} <= here.keys()
    assert differences(here, dict(here)) == ""
    assert differences(here, here | {"numpy": "1.0"}) == f"numpy 1.0 instead of {here['numpy']}"
    assert "triform none" in differences(here, {})
