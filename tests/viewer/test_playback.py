"""A recorded run as a film: what is shown at which moment."""

from __future__ import annotations

import numpy as np
import pytest

from triform.evaluation.rollout import Trajectory
from triform.types import ConfigurationError
from triform.viewer.playback import Playback


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def film(period=0.1, records=101, clock=None) -> Playback:
    time = np.arange(records) * period
    poses = np.zeros((1, records, 3, 3))
    poses[0, :, 0, 0] = time
    poses[0, :, 1, 1] = 1.0
    poses[0, :, 2, 1] = -1.0
    active = np.ones((1, records, 3), dtype=bool)
    active[0, : records // 2, 2] = False
    poses[~active] = np.nan
    return Playback(Trajectory(time, poses, active, np.full((1, records - 1, 3, 3), np.nan)), 1.0, clock or Clock())


@pytest.mark.parametrize("period", [0.1, 0.01])
def test_every_moment_shows_where_robots_were(period: float) -> None:
    playback = film(period)
    for moment in np.linspace(0.0, playback.duration, 37):
        picture = playback.picture_at(float(moment))
        assert picture.poses[0, 0] == pytest.approx(moment, abs=1e-9)
        assert len(picture.trail) * playback.period <= 4.0 + 2 * playback.period


def test_robots_come_when_they_came() -> None:
    playback = film()
    assert playback.picture_at(2.0).formation.robots.tolist() == [0, 1]
    assert playback.picture_at(8.0).formation.robots.tolist() == [0, 1, 2]


def test_the_clock_plays_it_to_its_end_and_from_its_beginning_again() -> None:
    clock = Clock()
    playback = film(clock=clock)
    clock.now = 3.0
    assert playback.now == pytest.approx(3.0)
    playback.speed = 2.0
    clock.now = 4.0
    assert playback.now == pytest.approx(5.0)
    assert len(playback.course().time) == 51
    playback.pause()
    clock.now = 9.0
    assert playback.now == pytest.approx(5.0)
    playback.step()
    assert playback.now == pytest.approx(5.1)
    playback.pause(False)
    clock.now = 99.0
    assert playback.now == playback.duration
    assert playback.paused
    playback.pause(False)
    assert playback.now == 0.0


@pytest.mark.parametrize("moment", [-0.1, 10.1, float("nan")])
def test_moments_that_a_run_has_not_are_refused(moment: float) -> None:
    with pytest.raises(ConfigurationError, match="the run lasts from 0 to 10 s"):
        film().seek(moment)
