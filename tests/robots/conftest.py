from __future__ import annotations

import os

import pytest

from triform.robots.gazebo import Installation, find_gazebo


@pytest.fixture(scope="session")
def gazebo() -> Installation:
    """The Gazebo that ``make gazebo`` made ready."""
    found = find_gazebo()
    if found is None:
        if "TRIFORM_REQUIRE_GAZEBO" in os.environ:
            pytest.fail("there is no Gazebo, and TRIFORM_REQUIRE_GAZEBO is set; run: make gazebo")
        pytest.skip("there is no Gazebo; run: make gazebo")
    return found
