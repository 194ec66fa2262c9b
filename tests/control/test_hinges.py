"""Hinges that a robot sees open, and what the law does about them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.control import Triangulating, TriangulatingLaw
from triform.control.hinge_kernels import hangs
from triform.control.triangulating_kernels import law_workspace, triangulate
from triform.evaluation.events import Event
from triform.evaluation.scenario import Scenario
from triform.geometry import body_to_world

LAW = TriangulatingLaw()


def towards(degrees: float, length: float = 1.0) -> np.ndarray:
    return length * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])


def look(others: np.ndarray, law: TriangulatingLaw = LAW) -> tuple[np.ndarray, list[bool]]:
    """Velocity [d*/s] of a robot at the origin, and who of the others hangs."""
    points = np.concatenate([np.zeros((1, 2)), others])
    workspace = law_workspace(len(points))
    workspace.x[:], workspace.y[:] = points.T
    v_x, v_y, _ = triangulate(len(points), law.constants, workspace)
    linked = workspace.linked
    return np.array([v_x, v_y]), [
        not linked[0, j] and hangs(workspace.x, workspace.y, len(points), linked, law.sight, j)
        for j in range(1, len(points))
    ]


def hinge(degrees: float, turn: float = 0.0) -> np.ndarray:
    """A neighbour, one that makes a triangle with it, and a robot that hangs from the neighbour, shape (3, 2).

    The robot at the origin and the one that hangs stand ``degrees`` apart around the neighbour.
    """
    neighbour = towards(0.0)
    others = np.stack([neighbour, towards(-60.0), neighbour + towards(180.0 - degrees)])
    return body_to_world(others, turn)


@settings(deadline=None, max_examples=40)
@given(st.one_of(st.floats(92.0, 96.0), st.floats(144.0, 178.0)), st.floats(-np.pi, np.pi))
def test_a_robot_beside_a_hinge_closes_it(degrees: float, turn: float) -> None:
    others = hinge(degrees, turn)
    velocity, hanging = look(others)
    assert hanging == [False, False, True]
    # All edges are as long as they should be, so there is nothing else to do.
    np.testing.assert_allclose(velocity, LAW.hinge_pull * others[2] / np.linalg.norm(others[2]), atol=1e-9)


@pytest.mark.parametrize("degrees", [100.0, 120.0, 140.0])
def test_a_robot_that_cannot_see_the_third_corner_stands_still(degrees: float) -> None:
    # Behind the neighbour may stand a robot that closes the triangle.
    velocity, hanging = look(hinge(degrees))
    assert not any(hanging)
    np.testing.assert_allclose(velocity, 0.0, atol=1e-9)


def test_a_robot_that_makes_a_triangle_does_not_hang() -> None:
    closing = towards(0.0) + towards(25.0)
    velocity, hanging = look(np.concatenate([hinge(95.0), [closing]]))
    assert not any(hanging)
    np.testing.assert_allclose(velocity, 0.0, atol=1e-9)


def test_a_robot_does_not_pull_at_what_is_near_the_end_of_its_sight() -> None:
    _, hanging = look(hinge(178.0), TriangulatingLaw(sight=2.01))
    assert any(hanging)
    _, hanging = look(hinge(178.0), TriangulatingLaw(sight=1.9))
    assert not any(hanging)


def test_edges_to_a_robot_with_few_neighbours_do_not_yield() -> None:
    # The far one has two neighbours, and all edges to it are too long.
    far = np.array([1.1 * towards(30.0), towards(90.0)])
    firm, _ = look(far)
    yielding, _ = look(far, TriangulatingLaw(firm_degree=0.0))
    along = (firm - yielding) @ towards(30.0)
    strain, most = 0.1, LAW.yield_strain
    assert along == pytest.approx(LAW.gain * (strain - most + LAW.yield_slope * (strain - most)))


@pytest.mark.parametrize("robots", [5, 7])
def test_a_team_forms_around_a_robot_that_never_moves(robots: int) -> None:
    scenario = Scenario(event=Event("stuck"))
    _, table = scenario.run(scenario.sample_starts(robots, 20, 5), Triangulating(), 5)
    assert table["strict"].sum() >= 18
