"""Behind a threshold of intensity a controller sees robots alone, and the safety filter sees everything."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from triform.control import IntensityThreshold, SafetyFilter, SafetySettings, make_controller
from triform.simulation import ROBOMASTER_EP, Arena, cast_scans
from triform.types import ConfigurationError, FloatArray, ScanConfig, TriformError, View


class Witness:
    """A controller that keeps what it sees and drives forward."""

    privileged = False

    @property
    def description(self) -> dict[str, Any]:
        return {"name": "witness"}

    def command(self, view: View) -> FloatArray:
        self.view = view
        return np.full((*view.active.shape, 3), [0.5, 0.0, 0.0])


RAYS = st.integers(1, 30)


@given(data=st.data(), rays=RAYS, least=st.floats(0, 255))
def test_only_dim_returns_are_left_out(data: st.DataObject, rays: int, least: float) -> None:
    kinds = st.floats(0.125, 2, width=32) | st.sampled_from([np.inf, -np.inf, np.nan])
    ranges = data.draw(arrays.arrays(np.float32, (2, rays), elements=kinds))
    levels = data.draw(arrays.arrays(np.float32, (2, rays), elements=st.floats(0, 255, width=32) | st.just(np.nan)))
    view, witness = View.of_scan(ranges, time=1.5, intensities=levels), Witness()
    commands = IntensityThreshold(witness, least).command(view)
    np.testing.assert_array_equal(commands[0, :, 0], 0.5)
    seen = witness.view
    for before, level, after in zip(view.scans.ranges.ravel(), levels.ravel(), seen.scans.ranges.ravel(), strict=True):
        is_return = np.isfinite(before) or before == -np.inf
        expected = before if not is_return or float(level) >= least else np.inf
        assert after == expected or (np.isnan(after) and np.isnan(expected))
    assert seen.time == view.time
    np.testing.assert_array_equal(view.scans.ranges[0], ranges)


def test_without_intensities_it_refuses_once_there_are_returns() -> None:
    guarded = IntensityThreshold(Witness(), 200)
    nothing = View.of_scan(np.array([np.inf, np.nan]))
    assert guarded.command(nothing)[0, 0, 0] == 0.5
    with pytest.raises(
        TriformError, match=r"^min_intensity is 200.*, but the scans say nothing about intensities; [^\n]*$"
    ):
        guarded.command(View.of_scan([1.0, np.inf]))
    with pytest.raises(ConfigurationError, match=r"min_intensity is -1\.?0?; it must be finite and not negative"):
        IntensityThreshold(Witness(), -1)
    assert guarded.description == {"name": "witness", "min_intensity": 200}


@settings(deadline=None, max_examples=40)
@given(bearing=st.floats(-np.pi, np.pi), distance=st.floats(0.5, 1.5), radius=st.floats(0.08, 0.25))
def test_the_policy_does_not_see_a_dim_pillar_and_a_bright_one_it_does(
    bearing: float, distance: float, radius: float
) -> None:
    """Without tape the map is empty: the command is that of a robot alone."""
    config = ScanConfig(range_max=3.0)
    pillar = np.array([[distance * np.cos(bearing), distance * np.sin(bearing), radius]])
    ranges = cast_scans(np.zeros((1, 1, 3)), np.ones((1, 1), bool), ROBOMASTER_EP, Arena(pillars=pillar), config)
    levels = np.where(np.isfinite(ranges), 200.0, 0.0)
    policy = POLICY
    alone = policy.command(View.of_scan(np.full(450, np.inf), config))
    dim = IntensityThreshold(policy, 230).command(View.of_scan(ranges, config, intensities=levels))
    np.testing.assert_array_equal(dim, alone)
    bright = IntensityThreshold(policy, 199).command(View.of_scan(ranges, config, intensities=levels))
    np.testing.assert_array_equal(bright, policy.command(View.of_scan(ranges, config)))


POLICY = make_controller("policy")


@settings(deadline=None, max_examples=40)
@given(gap=st.floats(0.0, 1.0), level=st.floats(0, 255))
def test_the_filter_limits_alike_whatever_the_intensity(gap: float, level: float) -> None:
    """A wall ahead: the speed towards it is that which the filter allows, bright or dim."""
    config, front = ScanConfig(), 0.16
    wall = Arena(walls=np.array([[front + gap, -9.0, front + gap, 9.0]]))
    ranges = cast_scans(np.zeros((1, 1, 3)), np.ones((1, 1), bool), ROBOMASTER_EP, wall, config)
    view = View.of_scan(ranges, config, time=9.0, intensities=np.full(ranges.shape, level))
    filtered = SafetyFilter(IntensityThreshold(Witness(), 230), SafetySettings()).command(view)
    allowed = SafetySettings().rate * max(0.0, gap - SafetySettings().min_gap)
    assert filtered[0, 0, 0] == pytest.approx(min(0.5, allowed), abs=1e-3)
    np.testing.assert_array_equal(filtered, SafetyFilter(Witness(), SafetySettings()).command(view))
