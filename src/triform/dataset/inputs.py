"""Fresh input for a policy of any kind, such as to compare two ways of computing it."""

from __future__ import annotations

import numpy as np

from triform.control import TriangulatingLaw
from triform.dataset.scenes import SceneConfig, draw_views
from triform.dataset.state_buffer import StateBuffer
from triform.dataset.teams import draw_states
from triform.policy import GnnConfig, PolicySpec, RadiusGraph
from triform.types import MapArray


def fresh_inputs(rng: np.random.Generator, robots: int, spec: PolicySpec) -> MapArray | RadiusGraph:
    """Occupancy maps of ``robots`` robots in random states, or, for a graph network, teams of at least as many.

    Args:
        rng: Source of all randomness.
        robots: Robots wanted.
        spec: The policy.
    """
    nowhere = StateBuffer.none()
    if isinstance(spec.network, GnnConfig):
        return draw_states(rng, robots, SceneConfig(), nowhere).graph(spec.network.reach)
    return draw_views(rng, robots, TriangulatingLaw(), SceneConfig(), nowhere, spec.scan, spec.map).maps
