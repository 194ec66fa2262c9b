from __future__ import annotations

import os
from importlib.util import find_spec

import pytest

from triform.simulators.gazebo import Installation, find_gazebo

#: The extra ``test``, for other versions of Python, comes without MuJoCo.
collect_ignore = [] if find_spec("mujoco") else ["test_mujoco_differential.py", "test_mujoco_team.py"]


@pytest.fixture(scope="session")
def gazebo() -> Installation:
    """The Gazebo that ``make gazebo`` made ready."""
    found = find_gazebo()
    if found is None:
        if "TRIFORM_REQUIRE_GAZEBO" in os.environ:
            pytest.fail("there is no Gazebo, and TRIFORM_REQUIRE_GAZEBO is set; run: make gazebo")
        pytest.skip("there is no Gazebo; run: make gazebo")
    return found
