"""Whatever a view holds, a command is finite, or there is a sentence instead of it."""

from __future__ import annotations

import functools
from contextlib import nullcontext, suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.control import CONTROLLERS, SafetyFilter, make_controller
from triform.types import Controller, PrivilegedView, Scan, ScanConfig, TriformError

SCAN = ScanConfig(rays=450, range_max=3.0)
ROBOTS = 3
odd = st.sampled_from([np.nan, np.inf, -np.inf, 1e308, -1e308, 1e200, 1e5, 0.0, 5e-324]) | st.floats()
places = st.lists(st.tuples(st.integers(0, ROBOTS * SCAN.rays - 1), odd), max_size=6)


@functools.cache
def controller_called(name: str) -> Controller[Any]:
    return SafetyFilter(make_controller(name))


def spoiled(values: np.ndarray, spoils: list[tuple[int, float]]) -> np.ndarray:
    flat = values.reshape(-1).copy()
    for place, value in spoils:
        flat[place % len(flat)] = value
    return flat.reshape(values.shape)


@pytest.mark.parametrize("name", CONTROLLERS)
@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), ranges=places, noise=places, odometry=places, poses=places)
def test_commands_are_finite_or_refused(
    name: str,
    seed: int,
    ranges: list[tuple[int, float]],
    noise: list[tuple[int, float]],
    odometry: list[tuple[int, float]],
    poses: list[tuple[int, float]],
) -> None:
    rng = np.random.default_rng(seed)
    seen = np.where(rng.random((1, ROBOTS, SCAN.rays)) < 0.3, rng.uniform(0.1, 2.0, (1, ROBOTS, SCAN.rays)), np.inf)

    def command() -> np.ndarray:
        view = PrivilegedView(
            Scan(spoiled(seen, ranges), SCAN),
            np.ones((1, ROBOTS), bool),
            2.0,
            spoiled(rng.uniform(-1.5, 1.5, (1, ROBOTS, 3)), poses),
            noise=spoiled(rng.standard_normal((1, ROBOTS, 2)), noise),
            odometry=spoiled(rng.uniform(-0.2, 0.2, (1, ROBOTS, 3)), odometry),
        )
        return controller_called(name).command(view)

    plausible = all(abs(value) <= 1e6 for _, value in [*noise, *odometry, *poses])
    with nullcontext() if plausible else suppress(TriformError):
        assert np.isfinite(command()).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308])
@pytest.mark.parametrize("field", ["noise", "odometry"])
def test_odometry_and_noise_that_are_no_numbers_are_refused_in_a_sentence(field: str, value: float) -> None:
    """Of robots that exist: a place without a robot may hold anything."""
    scans = Scan(np.full((1, 2, SCAN.rays), np.inf), SCAN)
    values = np.zeros((1, 2, 2 if field == "noise" else 3))
    values[0, 1, 1] = value
    poses = np.zeros((1, 2, 3))
    with pytest.raises(TriformError, match=f"{field} of active robots must be finite"):
        PrivilegedView(scans, np.ones((1, 2), bool), 0.0, poses, **{field: values})
    PrivilegedView(scans, np.array([[True, False]]), 0.0, poses, **{field: values})
