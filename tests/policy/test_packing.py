from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.policy import pack
from triform.types import ConfigurationError


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(0, 5), st.sampled_from([1, 2, 5]), st.floats(0, 0.5))
def test_packed_patches_rebuild_the_maps(seed: int, count: int, patch: int, density: float) -> None:
    maps = (np.random.default_rng(seed).random((count, 10, 10)) < density).astype(np.uint8)
    packed = pack(maps, patch)
    assert packed.counts.sum() == len(packed.positions) == len(packed.patches)
    assert (packed.patches.sum(axis=1) > 0).all()
    rebuilt = np.zeros_like(maps)
    columns = 10 // patch
    token = 0
    for m, kept in enumerate(packed.counts):
        positions = packed.positions[token : token + kept]
        assert (np.diff(positions) > 0).all()
        for position in positions:
            row, column = divmod(int(position), columns)
            rebuilt[m, row * patch : (row + 1) * patch, column * patch : (column + 1) * patch] = packed.patches[
                token
            ].reshape(patch, patch)
            token += 1
    np.testing.assert_array_equal(rebuilt, maps)


def test_keeping_all_keeps_all_in_order() -> None:
    packed = pack(np.zeros((2, 10, 10), np.uint8), 5, "all")
    np.testing.assert_array_equal(packed.counts, [4, 4])
    np.testing.assert_array_equal(packed.positions, [0, 1, 2, 3] * 2)


def test_maps_that_do_not_divide_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="do not divide"):
        pack(np.zeros((2, 10, 10), np.uint8), 3)
    with pytest.raises(ConfigurationError, match="do not divide"):
        pack(np.zeros((10, 10), np.uint8), 5)
