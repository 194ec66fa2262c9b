"""Short forms of the campaigns, with a fixed seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.fuzz import arcs, recordings


@pytest.mark.parametrize("kind", recordings.FORMATS)
def test_damaged_recordings_are_measured_or_refused_in_a_sentence(tmp_path: Path, kind: str) -> None:
    for index in range(50):
        recordings.run(np.random.default_rng([1, index]), kind, tmp_path)


def test_rolling_robots_behind_the_filter_never_collide() -> None:
    for index in range(3):
        assert not arcs.crash(np.random.default_rng([2, index]))
