"""Hinges that a robot sees open, compiled: who hangs from one of its neighbours by an edge without a triangle.

Lengths are in units of the prescribed distance d*. In doubt no robot hangs, so that none pulls at a formation whose
other robots it does not see.
"""

from __future__ import annotations

import numpy as np

from triform.kernels import kernel

#: Height of a triangle on an edge of length 1.
_HEIGHT = np.sqrt(0.75)
#: Longer edges may lead through a robot that is hidden.
_LONGEST_EDGE = 1.4
#: A place counts as hidden if a robot stands this near to the line of sight. More than half the width of a robot,
#: because whoever stands at a corner of a strained triangle stands beside its place.
_CLEARANCE = 0.2
#: A place counts as out of sight from this much within its end.
_SIGHT_MARGIN = 0.2


@kernel
def in_view(x, y, count, place_x, place_y, sight):
    """Whether the robot at the origin, point 0 of ``count``, would surely see another at a place."""
    squared = place_x * place_x + place_y * place_y
    if squared > (sight - _SIGHT_MARGIN) ** 2:
        return False
    for k in range(1, count):
        along = x[k] * place_x + y[k] * place_y
        if 0.0 < along < squared:
            across = x[k] * place_y - y[k] * place_x
            if across * across < _CLEARANCE * _CLEARANCE * squared:
                return False
    return True


@kernel
def hangs(x, y, count, linked, sight, j):
    """Whether point j hangs from a neighbour of the robot at the origin.

    It does if the edge between them lies in no triangle and the robot would see whoever stood at the third corner of
    one, on either side.

    Args:
        x: Where the robots that are seen stand, relative to point 0, which looks [d*], shape (>= count,).
        y: The same along the other axis.
        count: Points.
        linked: Gabriel graph of the points, shape (>= count, >= count).
        sight: How far the robot sees [d*].
        j: Who may hang: no neighbour of the robot that looks.
    """
    for k in range(1, count):
        if not (linked[0, k] and linked[j, k]):
            continue
        d_x, d_y = x[j] - x[k], y[j] - y[k]
        if d_x * d_x + d_y * d_y > _LONGEST_EDGE * _LONGEST_EDGE:
            continue
        shared = False
        for m in range(count):
            if linked[j, m] and linked[k, m]:
                shared = True
                break
        if shared:
            continue
        middle_x, middle_y = 0.5 * (x[j] + x[k]), 0.5 * (y[j] + y[k])
        up_x, up_y = -_HEIGHT * d_y, _HEIGHT * d_x
        if in_view(x, y, count, middle_x + up_x, middle_y + up_y, sight) and in_view(
            x, y, count, middle_x - up_x, middle_y - up_y, sight
        ):
            return True
    return False
