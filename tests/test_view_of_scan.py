"""A view from ranges alone: any numbers of any shape that fits, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from triform.types import ConfigurationError, ScanConfig, View

KINDS = st.sampled_from(["<f2", ">f2", "<f4", ">f4", "<f8", ">f8", "g", "i1", "u2", ">i4", "u8"])


@given(st.data(), KINDS, arrays.array_shapes(min_dims=1, max_dims=3, max_side=4))
def test_ranges_of_any_number_type_arrive_as_they_are(data: st.DataObject, kind: str, shape: tuple[int, ...]) -> None:
    # What every one of the types can hold.
    elements = st.floats(width=16) if np.dtype(kind).kind == "f" else st.integers(0, 100)
    ranges = data.draw(arrays.arrays(object, shape, elements=elements)).astype(kind)
    given_ranges = ranges.copy()
    view = View.of_scan(ranges, time=2.5)
    batch = (1,) * (3 - len(shape)) + shape
    assert view.scans.ranges.dtype == np.float64
    np.testing.assert_array_equal(view.scans.ranges, ranges.astype(np.float64).reshape(batch))
    assert view.scans.config == ScanConfig(rays=shape[-1], range_max=3.0)
    assert (view.active.shape, bool(view.active.all()), view.time) == (batch[:2], True, 2.5)
    view.scans.ranges[:] = 0.0
    np.testing.assert_array_equal(ranges, given_ranges)


def test_lists_will_do_and_so_does_a_scan_of_ones_own() -> None:
    config = ScanConfig(rays=3, angle_min=0.0, range_max=8.0)
    view = View.of_scan([[1, 2.5, float("inf")], [1, 1, 1]], config)
    assert view.scans.config is config
    np.testing.assert_array_equal(view.scans.ranges, [[[1.0, 2.5, np.inf], [1.0, 1.0, 1.0]]])
    with pytest.raises(ConfigurationError, match="must hold the 3 rays"):
        View.of_scan([1.0, 2.0], config)


@pytest.mark.parametrize(
    ("ranges", "says"),
    [
        ([1j, 2.0], "are of type complex128; numbers are needed"),
        (["1.0", "2.0"], "are of type <U3"),
        ([True, False], "are of type bool"),
        (None, "are of type object"),
        (np.array(["2026-01-01"], dtype="M8[D]"), r"are of type datetime64\[D\]"),
        ([[1.0], [1.0, 2.0]], "rows of several lengths"),
        (1.0, r"ranges of shape \(\) given"),
        (np.zeros((0, 4)), r"ranges of shape \(0, 4\) given"),
    ],
)
def test_what_is_no_ranges_is_refused(ranges: object, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        View.of_scan(ranges)  # type: ignore[arg-type]
