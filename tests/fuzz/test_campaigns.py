"""Short forms of the campaigns, with a fixed seed."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from tests.fuzz import arcs, recordings, robot_answers, sight, wheels


@pytest.mark.parametrize("kind", recordings.FORMATS)
def test_damaged_recordings_are_measured_or_refused_in_a_sentence(tmp_path: Path, kind: str) -> None:
    for index in range(50):
        recordings.run(np.random.default_rng([1, index]), kind, tmp_path)


def test_damaged_answers_and_pushes_leave_commands_finite() -> None:
    for index in range(100):
        robot_answers.dry(np.random.default_rng([1, index]))


#: Of this process.
ADDRESS = f"127.74.{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"


@pytest.mark.parametrize("fault", ["frozen keeper", "silent base", "closing with a frozen keeper"])
def test_wheels_stop_within_the_time_of_the_watchdog(fault: str) -> None:
    turned, closing = wheels.wheels_turn_for(fault, np.random.default_rng(1), ADDRESS)
    # It is 0.3 s; a machine under load may be late.
    assert turned < 1.0
    assert closing < 1.0


def test_a_damaged_robot_is_driven_or_lost_in_a_sentence_and_stands() -> None:
    for index in range(2):
        robot_answers.live(np.random.default_rng([1, index]), ADDRESS)


def test_a_robot_drives_by_how_long_ago_its_lidar_has_shown_anything() -> None:
    for index in range(60):
        assert sight.blindness(np.random.default_rng([1, index])) == ""


def test_rolling_robots_behind_the_filter_never_collide() -> None:
    for index in range(3):
        assert not arcs.crash(np.random.default_rng([2, index]))
