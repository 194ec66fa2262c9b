"""Robots that know late: how much slower they drive, and that it brings a team to rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.controllers import Given
from triform.control.safety import SafetyFilter, SafetySettings
from triform.control.triangulating import TriangulatingLaw
from triform.evaluation.filters import team_settings
from triform.evaluation.overrides import Overrides
from triform.evaluation.scenario import Scenario
from triform.simulation import HARDWARE, IDEAL, PROFILES, World, pace
from triform.simulation.noise import noise_in_body, noise_keys, noise_period
from triform.simulation.shipped import BURGER

LAW = TriangulatingLaw()
#: Commands a second and latency [s] with which the law is unstable at full pace.
LATE = [(5.0, 0.0), (2.0, 0.0), (1.0, 0.0), (10.0, 0.5)]
shares = st.floats(0.01, 1.0)
periods = st.floats(0.01, 3.0)


def late(rate: float, latency: float):
    return Overrides(scan_rate=rate, latency=latency).applied_to(IDEAL, 1.0)


def lattice() -> np.ndarray:
    """19 places of the triangular lattice with sides of 1, shape (19, 2)."""
    i, j = np.mgrid[-2:3, -2:3].reshape(2, -1)
    inside = np.abs(i + j) <= 2
    return np.stack([i + 0.5 * j, np.sqrt(0.75) * j], axis=1)[inside]


@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda profile: profile.name)
def test_shipped_robots_know_soon_enough_for_full_pace(profile) -> None:
    assert pace(profile) == 1.0
    assert team_settings((profile,))[0].pace == 1.0
    assert noise_period(profile.drive, pace(profile)) == noise_period(profile.drive)


@settings(deadline=None)
@given(periods, periods, st.floats(0.0, 3.0), st.booleans(), st.floats(1.0, 3.0))
def test_gain_times_time_is_bounded_and_the_pace_no_lower_than_that_needs(
    turn: float, hold: float, latency: float, rolling: bool, later: float
) -> None:
    lidar = replace(IDEAL.lidar, period=turn, rolling=rolling)
    robot = replace(IDEAL, lidar=lidar, control_period=hold, latency=latency)
    share, age = pace(robot), latency + turn / 2 + hold / 2 + (turn / 2 if rolling else 0.0)
    assert 0.0 < share <= 1.0
    assert share * hold <= 0.125 + 1e-12
    assert share * age <= 0.35 + 1e-12
    assert share == 1.0 or max(share * hold / 0.125, share * age / 0.35) == pytest.approx(1.0)
    for changed in (
        replace(robot, latency=latency * later),
        replace(robot, control_period=hold * later),
        replace(robot, lidar=replace(lidar, period=turn * later)),
    ):
        assert pace(changed) <= share


@pytest.mark.parametrize(("rate", "latency"), LATE)
def test_a_late_lattice_of_the_laws_springs_is_stable_at_its_pace_and_not_at_full_speed(
    rate: float, latency: float
) -> None:
    """Eigenvalues of the sampled linear network: each robot knows itself now, and the others late."""
    places, hold = lattice(), 1 / rate
    count, delay = len(places), round(latency * rate)
    own, others = np.zeros((2 * count, 2 * count)), np.zeros((2 * count, 2 * count))
    for i in range(count):
        for j in range(count):
            way = places[j] - places[i]
            if i != j and np.hypot(*way) < 1.01:
                across = np.array([-way[1], way[0]])
                spring = LAW.gain * np.outer(way, way) + LAW.odd_gain * np.outer(across, way)
                own[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += spring
                others[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = spring

    def growth(share: float) -> float:
        steps = np.eye(2 * count * (delay + 1), k=-2 * count)
        steps[: 2 * count, : 2 * count] = np.eye(2 * count) - share * hold * own
        steps[: 2 * count, -2 * count :] += share * hold * others
        return float(np.abs(np.linalg.eigvals(steps)).max())

    # Motions of the whole patch, which no spring resists, neither grow nor shrink.
    assert growth(pace(late(rate, latency))) < 1 + 1e-6
    assert growth(1.0) > 1.01


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), shares)
def test_the_filter_drives_a_share_of_every_command_and_judges_that(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    view = World(rng.uniform(-1, 1, (2, 5, 3)), IDEAL).observe()
    view = replace(view, time=9.0)
    wanted = rng.normal(0, 0.3, (2, 5, 3)) * [1, 1, rng.integers(2)]
    slowed = SafetyFilter(Given(wanted), SafetySettings(pace=share)).command(view)
    np.testing.assert_array_equal(slowed, SafetyFilter(Given(share * wanted), SafetySettings()).command(view))


@settings(deadline=None, max_examples=40)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-2, 2), shares)
def test_wheels_turn_at_the_same_share(x: float, y: float, omega: float, share: float) -> None:
    wanted, rules = np.array([[[x, y, omega]]]), team_settings((BURGER,))[0]
    view = replace(World(np.zeros((1, 1, 3)), BURGER, seeds=[0]).observe(), time=9.0)
    view = replace(view, scans=replace(view.scans, ranges=np.full_like(view.scans.ranges, np.inf)))
    full = SafetyFilter(Given(wanted), rules).command(view)
    np.testing.assert_array_equal(SafetyFilter(Given(wanted), replace(rules, pace=share)).command(view), share * full)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), st.floats(0.1, 100.0), st.sampled_from([0.5, 0.25, 0.125]))
def test_noise_at_a_pace_is_that_of_slower_time(seed: int, time: float, share: float) -> None:
    keys = noise_keys([np.random.SeedSequence(seed)], 1)
    for drive in (IDEAL.drive, BURGER.drive):
        slow = noise_in_body(keys, drive, time / share, np.zeros((1, 3)), pace=share)
        np.testing.assert_array_equal(slow, noise_in_body(keys, drive, time, np.zeros((1, 3))))


def test_each_kind_of_a_mixed_team_keeps_its_own_pace() -> None:
    slow, fast = team_settings((late(2.0, 0.0), HARDWARE))
    assert (slow.pace, fast.pace) == (pytest.approx(0.25), 1.0)


@pytest.mark.parametrize("controller", ["triangulating", "scan-triangulating"])
def test_a_team_with_two_scans_a_second_comes_to_rest(controller: str) -> None:
    scenario = Scenario(duration=60.0, overrides=Overrides(scan_rate=2.0))
    _, table = scenario.run(scenario.sample_starts(5, 4, 33), controller, 33)
    assert table["strict"].all()
    assert not table["collision"].any()
    assert table["settled_speed"].max() < 2e-3
