"""The triangulating law of one robot, compiled: what it does about the robots that it sees.

Lengths are in units of the prescribed distance d* and speeds in d*/s throughout, so that one law serves all distances.
The law is derived and its terms are named in docs/triangulating.md; ``TriangulatingLaw`` says what each constant means.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from triform.control.hinge_kernels import hangs
from triform.kernels import kernel

#: Features of a robot's surroundings, see ``LawWorkspace``.
LAW_FEATURES = 5
#: Features of a seen robot, see ``LawWorkspace``.
LAW_EDGE_FEATURES = 4
#: Steps of the search for the centre of the smallest circle around all; its error falls as one over their number.
_CIRCLE_STEPS = 25
#: Edges count as loose if both ends are nearer than sight by this much: who might stand between them is then in sight.
_LOOSE_MARGIN = 0.7
#: But no farther than this: beyond, robots hide those between others.
_LOOSE_REACH = 2.3


class LawConstants(NamedTuple):
    """Constants of the law; ``TriangulatingLaw`` says what each means, and its unit."""

    sight: float
    contact_gain: float
    contact_range: float
    gain: float
    yield_strain: float
    yield_slope: float
    far_range: float
    far_gain: float
    odd_gain: float
    compaction_speed: float
    loose_length: float
    loose_width: float
    squeeze_limit: float
    squeeze_width: float
    bridge_pull: float
    bridge_push: float
    hinge_pull: float
    firm_degree: float
    strain_push: float
    strain_limit: float
    strain_width: float


class LawWorkspace(NamedTuple):
    """What the law reads and writes about one robot and those around it, in any fixed orientation.

    Attributes:
        x: Where the robots that are seen stand, relative to the one that looks [d*]; point 0 is that robot itself, at
            the origin, shape (K,).
        y: The same along the other axis.
        all_x: The same of all robots in reach, hidden ones among them; the law does not read it.
        all_y: The same along the other axis.
        linked: Gabriel graph of the points, bool, shape (K, K).
        edge_features: Of every seen robot: what it adds to the velocity by itself (2) [d*/s], whether it is a Gabriel
            neighbour and whether it shares one with the robot that looks, shape (K, LAW_EDGE_FEATURES).
        features: Whether the robot has a bridge, strain, looseness, and the direction of compaction (2), shape
            (LAW_FEATURES,).
    """

    x: Any
    y: Any
    all_x: Any
    all_y: Any
    linked: Any
    edge_features: Any
    features: Any


@kernel
def law_workspace(points):
    """A ``LawWorkspace`` for up to ``points`` robots, the one that looks among them."""
    return LawWorkspace(
        np.empty(points), np.empty(points), np.empty(points), np.empty(points),
        np.empty((points, points), dtype=np.bool_), np.empty((points, LAW_EDGE_FEATURES)), np.empty(LAW_FEATURES),
    )  # fmt: skip


@kernel
def _link(x, y, count, sight, linked):
    """Write the Gabriel graph of ``count`` points, shape (>= count, >= count); longer edges than ``sight`` are none."""
    for a in range(count):
        linked[a, a] = False
        for b in range(a):
            d_x, d_y = x[a] - x[b], y[a] - y[b]
            joined = d_x * d_x + d_y * d_y <= sight * sight
            if joined:
                for k in range(count):
                    # Negative if k sees the pair under an obtuse angle; of a itself and b the product is zero.
                    if (x[a] - x[k]) * (x[b] - x[k]) + (y[a] - y[k]) * (y[b] - y[k]) < 0.0:
                        joined = False
                        break
            linked[a, b] = linked[b, a] = joined


@kernel
def _looseness(x, y, radius, count, linked, reach, loose_length, loose_width):
    """How far the longest edge within ``reach`` exceeds ``loose_length``, from 0 to 1 over ``loose_width``."""
    loose = 0.0
    for a in range(count):
        if radius[a] > reach:
            continue
        for b in range(a):
            if linked[a, b] and radius[b] <= reach:
                length = np.sqrt((x[a] - x[b]) ** 2 + (y[a] - y[b]) ** 2)
                loose = max(loose, min(1.0, (length - loose_length) / loose_width))
    return loose


@kernel
def _circle_centre(x, y, count):
    """Centre of the smallest circle around ``count`` points, by Badoiu and Clarkson's steps towards the farthest."""
    c_x = c_y = 0.0
    for step in range(1, _CIRCLE_STEPS):
        farthest, far_x, far_y = -1.0, 0.0, 0.0
        for k in range(count):
            squared = (x[k] - c_x) ** 2 + (y[k] - c_y) ** 2
            if squared > farthest:
                farthest, far_x, far_y = squared, x[k], y[k]
        c_x += (far_x - c_x) / (step + 1)
        c_y += (far_y - c_y) / (step + 1)
    return c_x, c_y


@kernel
def triangulate(count, law, workspace):
    """The law of one robot.

    Args:
        count: Points, this robot and those that it sees.
        law: ``LawConstants``.
        workspace: ``LawWorkspace`` with the points; its graph and features are filled.

    Returns:
        Mean velocity (v_x, v_y) and the standard deviation along each axis of the exploration noise upon it [d*/s].
    """
    x, y, linked = workspace.x, workspace.y, workspace.linked
    edge_features, features = workspace.edge_features, workspace.features
    features[:] = 0.0
    if count < 2:
        return 0.0, 0.0, 0.0
    _link(x, y, count, law.sight, linked)
    radius = np.empty(count)
    for k in range(count):
        radius[k] = np.sqrt(x[k] * x[k] + y[k] * y[k])
    v_x = v_y = away_x = away_y = largest = smallest = 0.0
    bridge = in_triangle = False
    for j in range(1, count):
        if radius[j] == 0.0:
            # Robots in one place have no direction from each other.
            edge_features[j] = 0.0
            continue
        u_x, u_y = x[j] / radius[j], y[j] / radius[j]
        strain = radius[j] - 1.0
        shared = False
        for k in range(1, count):
            if linked[0, k] and linked[j, k]:
                shared = True
                break
        along = across = 0.0
        if radius[j] < law.contact_range:
            along += law.contact_gain * (radius[j] - law.contact_range)
        if linked[0, j]:
            # Two robots cannot make a triangle: they keep their distance and nothing more.
            bridge = bridge or (not shared and count > 2)
            in_triangle = in_triangle or shared
            degree = 0
            for k in range(count):
                degree += linked[j, k]
            # Bridges do not yield: they are all that holds two parts of a team together. Nor do edges to a robot with
            # few neighbours: it may be one that cannot come.
            if strain < law.yield_strain or not shared or degree <= law.firm_degree:
                along += law.gain * strain
            else:
                along += law.gain * (law.yield_strain - law.yield_slope * (strain - law.yield_strain))
            if radius[j] > law.far_range:
                along += law.far_gain * (radius[j] - law.far_range)
            across = law.odd_gain * strain
            largest = max(largest, abs(strain))
            smallest = min(smallest, strain)
        else:
            if strain < 0.0:
                along += law.gain * strain
            if hangs(x, y, count, linked, law.sight, j):
                along += law.hinge_pull
            away_x += u_x
            away_y += u_y
        edge_features[j, 0] = along * u_x - across * u_y
        edge_features[j, 1] = along * u_y + across * u_x
        edge_features[j, 2] = 1.0 if linked[0, j] else 0.0
        edge_features[j, 3] = 1.0 if shared else 0.0
        v_x += edge_features[j, 0]
        v_y += edge_features[j, 1]
    strained = max(0.0, min(1.0, (largest - law.strain_limit) / law.strain_width))
    reach = min(law.sight - _LOOSE_MARGIN, _LOOSE_REACH)
    loose = _looseness(x, y, radius, count, linked, reach, law.loose_length, law.loose_width)
    # A robot that its neighbours squeeze has no room to go to: it leaves compaction to those with room.
    loose *= 1.0 - max(0.0, min(1.0, (-smallest - law.squeeze_limit) / law.squeeze_width))
    features[0], features[1], features[2] = 1.0 if bridge else 0.0, strained, loose
    if loose > 0.0:
        c_x, c_y = _circle_centre(x, y, count)
        scale = loose / max(np.sqrt(c_x * c_x + c_y * c_y), 0.2)
        features[3], features[4] = scale * c_x, scale * c_y
        v_x += law.compaction_speed * features[3]
        v_y += law.compaction_speed * features[4]
    push = law.strain_push * strained
    if bridge:
        push = law.bridge_push
    # A robot with a triangle stays with it: it leaves the hinge to the robots around it.
    if bridge and not in_triangle:
        length = np.sqrt(away_x * away_x + away_y * away_y) + 1e-9
        v_x += law.bridge_pull * away_x / length
        v_y += law.bridge_pull * away_y / length
    return v_x, v_y, push


@kernel
def hidden(x, y, count, j, blocking):
    """Whether a disc of radius ``blocking`` around another point blocks the line from the origin to point j."""
    length = x[j] * x[j] + y[j] * y[j]
    for k in range(1, count):
        if k != j:
            along = x[k] * x[j] + y[k] * y[j]
            if 0.0 < along < length:
                across = x[k] * y[j] - y[k] * x[j]
                if across * across < blocking * blocking * length:
                    return True
    return False
