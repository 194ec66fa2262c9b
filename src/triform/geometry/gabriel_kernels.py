"""Compiled search for the Gabriel neighbours of robots, exact and in constant time for each.

Robot k lies strictly inside the circle over i and j iff ``(p_i - p_k) . (p_j - p_k) < 0``: it *blocks* the pair. Seen
from i, everything behind the line through k at right angles to i - k is blocked, so i's neighbours lie in a polygon
whose sides go through the nearest robots around it. Once that polygon is closed, nobody beyond its farthest corner can
be a neighbour; and who blocks a neighbour is nearer to i than the neighbour is.
"""

from __future__ import annotations

import numpy as np

from triform.geometry.cells import SEARCH_DEPTH, box_distance, extended, find_near, squared_distance
from triform.kernels import kernel

#: How far around a cell is looked, as squared distances in units of the area per robot: first, and if need be.
_INNER, _OUTER = 8.0, 20.0
#: A polygon ends before its farthest corner times this, squared, whatever was rounded ...
_MARGIN = 1.002
#: ... unless a side is this much nearer than the corner, squared.
_NEAREST = 1e-20
#: Share of a squared distance that is more than any rounding.
_ROUNDING = 1e-12


@kernel
def make_workspace(count):
    """Workspace of ``list_neighbours`` among ``count`` robots."""
    stack = np.empty(SEARCH_DEPTH, dtype=np.int64)
    near = np.empty(count, dtype=np.int64)
    return stack, near, np.empty(count), np.empty(count), np.empty(count), np.empty(count, dtype=np.int64)


@kernel
def list_neighbours(world, cell, limit, workspace, listed, ends):
    """List the Gabriel neighbours of the robots in a cell, as exactly as the definition.

    Args:
        world: Cells.
        cell: One of the parts that are cells.
        limit: Square of the longest edge [m^2].
        workspace: What ``make_workspace`` returned.
        listed: Robots to write, int64, shape (L, 1).
        ends: Where the lists end to write: the k-th robot of the cell has the neighbours ``listed[ends[k] : ends[k +
            1]]``, in growing order; int64, shape (M + 1,).

    Returns:
        ``listed``, or a longer array in its place.
    """
    robots, places, parts, boxes = world
    stack, near, near_x, near_y, apart, found = workspace
    parent = parts[cell, 3]
    area = (boxes[parent, 2] - boxes[parent, 0]) * (boxes[parent, 3] - boxes[parent, 1])
    area /= max(parts[parent, 1] - parts[parent, 0], 1)
    if not area < np.inf:
        area = 0.0
    inner, outer = min(_INNER * area, limit), min(_OUTER * area, limit)
    number = find_near(world, cell, outer * (1.0 + _ROUNDING), stack, near)
    for k in range(number):
        near_x[k], near_y[k] = places[near[k], 0], places[near[k], 1]
    filled = 0
    ends[0] = 0
    for own in range(parts[cell, 0], parts[cell, 1]):
        x, y = places[own, 0], places[own, 1]
        for k in range(number):
            d_x, d_y = near_x[k] - x, near_y[k] - y
            apart[k] = d_x * d_x + d_y * d_y
        count = 0
        for k in range(number):
            if apart[k] <= inner and near[k] != own:
                count = _consider(places, own, near[k], count, found)
        complete = inner == limit
        if not complete:
            reach = _reach(places, own, count, found)
            if reach > inner:
                for k in range(number):
                    if inner < apart[k] <= min(reach, outer):
                        count = _consider(places, own, near[k], count, found)
            complete = reach <= outer or outer == limit or _reach(places, own, count, found) <= outer
        if complete:
            farthest = _farthest(places, own, count, found)
            for k in range(number):
                if apart[k] <= farthest and near[k] != own:
                    count = _strike(places, own, near[k], count, found)
        else:
            count = _search_candidates(world, own, limit, stack, found)
            count = _search_blockers(world, own, count, stack, found)
        _sort_found(robots, found, count)
        listed = extended(listed, filled + count)
        for k in range(count):
            listed[filled + k, 0] = robots[found[k]]
        filled += count
        ends[own - parts[cell, 0] + 1] = filled
    return listed


@kernel
def _sort_found(robots, found, count):
    """Sort slots by the robots in them."""
    for k in range(1, count):
        slot = found[k]
        place = k
        while place > 0 and robots[found[place - 1]] > robots[slot]:
            found[place] = found[place - 1]
            place -= 1
        found[place] = slot


@kernel
def _blocks(places, own, k, j):
    """Whether slot k lies strictly inside the circle over the slots ``own`` and j."""
    x, y = places[k, 0], places[k, 1]
    return (places[own, 0] - x) * (places[j, 0] - x) + (places[own, 1] - y) * (places[j, 1] - y) < 0.0


@kernel
def _consider(places, own, slot, count, found):
    """Enter a slot among the ``count`` candidates unless one blocks it, and drop those that it blocks."""
    for c in range(count):
        if _blocks(places, own, found[c], slot):
            return count
    count = _strike(places, own, slot, count, found)
    found[count] = slot
    return count + 1


@kernel
def _strike(places, own, slot, count, found):
    """Drop the candidates that a slot blocks; return how many are left."""
    left = 0
    for c in range(count):
        if found[c] == slot or not _blocks(places, own, slot, found[c]):
            found[left] = found[c]
            left += 1
    return left


@kernel
def _farthest(places, own, count, found):
    """Squared distance beyond which nobody blocks a candidate [m^2]."""
    farthest = 0.0
    for c in range(count):
        farthest = max(farthest, squared_distance(places, own, found[c]))
    return farthest * (1.0 + _ROUNDING)


@kernel
def _turn(d_x, d_y):
    """Grows with the angle of a vector."""
    share = d_x / (abs(d_x) + abs(d_y))
    return share - 1.0 if d_y < 0.0 else 1.0 - share


@kernel
def _reach(places, own, count, found):
    """Squared distance beyond which the candidates block everything [m^2]; ``inf`` while their polygon is open.

    No candidate blocks another, so each lies on a side of its own, and the corners are where the lines of candidates
    that follow each other in angle meet.
    """
    if count < 3:
        return np.inf
    x, y = places[own, 0], places[own, 1]
    nearest = np.inf
    for c in range(count):
        nearest = min(nearest, squared_distance(places, own, found[c]))
    if nearest == 0.0:
        return np.inf
    for c in range(1, count):
        slot = found[c]
        turn = _turn(places[slot, 0] - x, places[slot, 1] - y)
        place = c
        while place > 0 and _turn(places[found[place - 1], 0] - x, places[found[place - 1], 1] - y) > turn:
            found[place] = found[place - 1]
            place -= 1
        found[place] = slot
    corner = 0.0
    a_x, a_y = places[found[count - 1], 0] - x, places[found[count - 1], 1] - y
    for c in range(count):
        b_x, b_y = places[found[c], 0] - x, places[found[c], 1] - y
        cross = a_x * b_y - a_y * b_x
        if cross <= 0.0:
            return np.inf
        # The corner is opposite to the robot on the circle through it and both candidates.
        side = (a_x - b_x) * (a_x - b_x) + (a_y - b_y) * (a_y - b_y)
        corner = max(corner, side * ((a_x * a_x + a_y * a_y) / cross) * ((b_x * b_x + b_y * b_y) / cross))
        a_x, a_y = b_x, b_y
    return _MARGIN * corner if nearest > _NEAREST * corner else np.inf


@kernel
def _hidden(places, own, boxes, part, count, found):
    """Whether one of the candidates blocks all of a box; by monotony that holds with rounding too."""
    for c in range(count):
        k_x, k_y = places[found[c], 0], places[found[c], 1]
        d_x, d_y = places[own, 0] - k_x, places[own, 1] - k_y
        x = boxes[part, 2] if d_x > 0.0 else boxes[part, 0]
        y = boxes[part, 3] if d_y > 0.0 else boxes[part, 1]
        if d_x * (x - k_x) + d_y * (y - k_y) < 0.0:
            return True
    return False


@kernel
def _search_candidates(world, own, limit, stack, found):
    """List robots that no other listed one blocks, among all; every neighbour is listed."""
    _, places, parts, boxes = world
    x, y = places[own, 0], places[own, 1]
    count = 0
    stack[0] = 0
    top = 1
    while top > 0:
        top -= 1
        part = stack[top]
        if box_distance(boxes, part, x, y) > limit or _hidden(places, own, boxes, part, count, found):
            continue
        half = parts[part, 2]
        if half > 0:
            # The nearer half comes first, because what is found in it may hide the other.
            first_is_far = box_distance(boxes, half, x, y) > box_distance(boxes, half + 1, x, y)
            stack[top] = half if first_is_far else half + 1
            stack[top + 1] = half + 1 if first_is_far else half
            top += 2
            continue
        for slot in range(parts[part, 0], parts[part, 1]):
            if slot != own and squared_distance(places, own, slot) <= limit:
                count = _consider(places, own, slot, count, found)
    return count


@kernel
def _least_product(low, high, a, b):
    """Smallest ``(a - x) (b - x)`` for x between ``low`` and ``high``."""
    middle = 0.5 * (a + b)
    if middle < low:
        return (a - low) * (b - low)
    if middle > high:
        return (a - high) * (b - high)
    return -0.25 * (a - b) * (a - b)


@kernel
def _in_a_circle(places, own, boxes, part, count, found):
    """Whether a box may reach into the circle over the robot and one of the candidates."""
    x, y = places[own, 0], places[own, 1]
    for c in range(count):
        j = found[c]
        least = _least_product(boxes[part, 0], boxes[part, 2], x, places[j, 0])
        least += _least_product(boxes[part, 1], boxes[part, 3], y, places[j, 1])
        if least <= _ROUNDING * squared_distance(places, own, j):
            return True
    return False


@kernel
def _search_blockers(world, own, count, stack, found):
    """Drop the candidates that anybody blocks; return how many are left."""
    _, places, parts, boxes = world
    farthest = _farthest(places, own, count, found)
    stack[0] = 0
    top = 1
    while top > 0 and count > 0:
        top -= 1
        part = stack[top]
        distance = box_distance(boxes, part, places[own, 0], places[own, 1])
        if distance > farthest or not _in_a_circle(places, own, boxes, part, count, found):
            continue
        half = parts[part, 2]
        if half > 0:
            stack[top], stack[top + 1] = half, half + 1
            top += 2
            continue
        for slot in range(parts[part, 0], parts[part, 1]):
            if slot != own:
                count = _strike(places, own, slot, count, found)
    return count
