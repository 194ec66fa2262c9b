"""The triangulating law of one robot, compiled: what it does about the robots that it sees.

Lengths are in units of the prescribed distance d* and speeds in d*/s throughout, so that one law serves all distances.
The law is derived and its terms are named in docs/method.md; ``TriangulatingLaw`` says what each constant means.
"""

from __future__ import annotations

import numpy as np

from triform.kernels import kernel

#: Facts about a robot's surroundings that ``triangulate`` also tells: see there.
FEATURES = 5
#: Columns that describe a seen robot: see ``triangulate``.
EDGE_TERMS = 4
#: Steps of the search for the centre of the smallest circle around all; its error falls as one over their number.
_CIRCLE_STEPS = 25
#: Edges count as loose if both ends are within this distance of the robot.
_LOOSE_REACH = 1.5


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
def _looseness(x, y, radius, count, linked, loose_length, loose_width):
    """How far the longest edge near the robot exceeds ``loose_length``, from 0 to 1 over ``loose_width``."""
    loose = 0.0
    for a in range(count):
        if radius[a] > _LOOSE_REACH:
            continue
        for b in range(a):
            if linked[a, b] and radius[b] <= _LOOSE_REACH:
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
def triangulate(x, y, count, law, linked, terms, facts):
    """The law of one robot.

    Args:
        x: Where the robots are, relative to this one, in any fixed orientation [d*]; point 0 is the robot itself, at
            the origin, shape (>= count,).
        y: The same along the other axis.
        count: Points, this robot and those that it sees.
        law: ``TriangulatingLaw.constants``.
        linked: Room for the Gabriel graph of the points, bool, shape (>= count, >= count); holds it afterwards.
        terms: To fill for every seen robot: what it adds to the velocity by itself (2) [d*/s], whether it is a
            Gabriel neighbour and whether it shares one with this robot, shape (>= count, EDGE_TERMS).
        facts: To fill: whether the robot has a bridge, strain, looseness, and the direction of compaction (2), shape
            (FEATURES,).

    Returns:
        Mean velocity (v_x, v_y) and the standard deviation along each axis of the random push upon it [d*/s].
    """
    (
        sight, contact_gain, contact_range, gain, yield_strain, yield_slope, far_range, far_gain, odd_gain,
        compaction_speed, loose_length, loose_width, bridge_pull, bridge_push, strain_push, strain_limit, strain_width,
    ) = law  # fmt: skip
    facts[:] = 0.0
    if count < 2:
        return 0.0, 0.0, 0.0
    _link(x, y, count, sight, linked)
    radius = np.empty(count)
    for k in range(count):
        radius[k] = np.sqrt(x[k] * x[k] + y[k] * y[k])
    v_x = v_y = away_x = away_y = largest = 0.0
    bridge = False
    for j in range(1, count):
        if radius[j] == 0.0:
            # Robots in one place have no direction from each other.
            terms[j] = 0.0
            continue
        u_x, u_y = x[j] / radius[j], y[j] / radius[j]
        strain = radius[j] - 1.0
        shared = False
        for k in range(1, count):
            if linked[0, k] and linked[j, k]:
                shared = True
                break
        along = across = 0.0
        if radius[j] < contact_range:
            along += contact_gain * (radius[j] - contact_range)
        if linked[0, j]:
            # Two robots cannot make a triangle: they keep their distance and nothing more.
            bridge = bridge or (not shared and count > 2)
            # Bridges do not yield: they are all that holds two parts of a team together.
            if strain < yield_strain or not shared:
                along += gain * strain
            else:
                along += gain * (yield_strain - yield_slope * (strain - yield_strain))
            if radius[j] > far_range:
                along += far_gain * (radius[j] - far_range)
            across = odd_gain * strain
            largest = max(largest, abs(strain))
        else:
            if strain < 0.0:
                along += gain * strain
            away_x += u_x
            away_y += u_y
        terms[j, 0] = along * u_x - across * u_y
        terms[j, 1] = along * u_y + across * u_x
        terms[j, 2] = 1.0 if linked[0, j] else 0.0
        terms[j, 3] = 1.0 if shared else 0.0
        v_x += terms[j, 0]
        v_y += terms[j, 1]
    strained = max(0.0, min(1.0, (largest - strain_limit) / strain_width))
    loose = _looseness(x, y, radius, count, linked, loose_length, loose_width)
    facts[0], facts[1], facts[2] = 1.0 if bridge else 0.0, strained, loose
    if loose > 0.0:
        c_x, c_y = _circle_centre(x, y, count)
        scale = loose / max(np.sqrt(c_x * c_x + c_y * c_y), 0.2)
        facts[3], facts[4] = scale * c_x, scale * c_y
        v_x += compaction_speed * facts[3]
        v_y += compaction_speed * facts[4]
    push = strain_push * strained
    if bridge:
        length = np.sqrt(away_x * away_x + away_y * away_y) + 1e-9
        v_x += bridge_pull * away_x / length
        v_y += bridge_pull * away_y / length
        push = bridge_push
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
