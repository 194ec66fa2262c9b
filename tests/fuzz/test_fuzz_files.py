"""Short forms of the campaigns on files; the long ones are commands of their own."""

from __future__ import annotations

import sys

import pytest

needs_fork = pytest.mark.skipif(sys.platform == "win32", reason="this system starts no copies of a process")


def test_damaged_and_absurd_policies_are_refused() -> None:
    from tests.fuzz import policies

    assert policies.run(500) == 0


def test_damaged_and_absurd_data_sets_are_refused() -> None:
    from tests.fuzz import data_sets

    assert data_sets.run(40) == 0


@needs_fork
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_killed_writers_leave_the_old_or_the_new() -> None:
    from tests.fuzz import kills

    assert kills.run(8) == 0


@needs_fork
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_writers_of_one_file_do_not_disturb_each_other() -> None:
    from tests.fuzz import writers

    assert writers.run(1.0) == 0
