"""Neighbour search by cells: a cell is a square, or half of one, that holds a few robots.

The square around a team is halved, now along x and now along y, until no part holds more than ``CELL_SIZE`` robots;
halves without robots are left out. So cells are small where robots are dense and large where they are far apart: a
search takes the same time per robot in a team of 100 and of 100,000, and the memory is linear in the number of robots
however far they have spread. (Places that agree in the first 24 halvings along both axes are not told apart, so one
robot a billion metres away makes searches slow, though not wrong.)

Kernels take the cells of one world as a tuple ``(robots, places, parts, boxes)``. Robots are listed cell by cell, in
*slots*: ``robots[slot]`` is the index of the robot and ``places[slot]`` its position [m]. Part p of the square, the
whole being part 0, holds the slots ``parts[p, 0] <= slot < parts[p, 1]``, whose robots lie in ``boxes[p]`` (low x,
low y, high x, high y). Its halves are the parts ``parts[p, 2]`` and the next one, or it is a cell and ``parts[p, 2]``
is 0. It is itself a half of part ``parts[p, 3]``.
"""

from __future__ import annotations

import numpy as np

from triform.kernels import kernel

#: Most robots in one cell, unless more stand in the same place.
CELL_SIZE = 16
#: Up to this many robots, comparing all with all is faster than making cells.
SMALL_TEAM = 32
#: Room for the parts that a search has yet to look into: two for each halving.
SEARCH_DEPTH = 128

#: Halvings along each axis.
_BITS = 24


@kernel
def _spread_bits(value):
    """Put a zero before every bit of a number of ``_BITS`` bits."""
    value = (value | (value << np.uint64(16))) & np.uint64(0x0000FFFF0000FFFF)
    value = (value | (value << np.uint64(8))) & np.uint64(0x00FF00FF00FF00FF)
    value = (value | (value << np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    value = (value | (value << np.uint64(2))) & np.uint64(0x3333333333333333)
    return (value | (value << np.uint64(1))) & np.uint64(0x5555555555555555)


@kernel
def _sort_robots(positions, active):
    """Active robots in the order of their keys, and the keys: which half, halving by halving (Morton order)."""
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    count = 0
    for i in range(active.shape[0]):
        if active[i]:
            low_x, high_x = min(low_x, positions[i, 0]), max(high_x, positions[i, 0])
            low_y, high_y = min(low_y, positions[i, 1]), max(high_y, positions[i, 1])
            count += 1
    robots = np.empty(count, dtype=np.int64)
    keys = np.empty(count, dtype=np.uint64)
    side = max(high_x - low_x, high_y - low_y)
    scale = ((1 << _BITS) - 1) / side if 0.0 < side < np.inf else 0.0
    if not scale < np.inf:
        scale = 0.0
    slot = 0
    for i in range(active.shape[0]):
        if active[i]:
            robots[slot] = i
            keys[slot] = 0
            if scale > 0.0:
                column = np.uint64((positions[i, 0] - low_x) * scale)
                row = np.uint64((positions[i, 1] - low_y) * scale)
                keys[slot] = (_spread_bits(column) << np.uint64(1)) | _spread_bits(row)
            slot += 1
    order = np.argsort(keys, kind="mergesort")
    return robots[order], keys[order]


@kernel
def _middle(keys, first, last):
    """First slot of the upper half of a part whose keys are not all equal."""
    differ = keys[first] ^ keys[last - 1]
    # Spreads the highest bit in which the keys differ to all lower ones.
    for shift in (1, 2, 4, 8, 16, 32):
        differ |= differ >> np.uint64(shift)
    bit = differ ^ (differ >> np.uint64(1))
    low, high = first, last - 1
    while high - low > 1:
        middle = (low + high) // 2
        if keys[middle] & bit:
            high = middle
        else:
            low = middle
    return high


@kernel
def make_cells(positions, active):
    """Sort the active robots of one world into cells.

    Args:
        positions: Positions [m], shape (N, 2) or (N, 3) with anything in the third column.
        active: Robots that exist, shape (N,); the others are left out.

    Returns:
        The cells of the world.
    """
    robots, keys = _sort_robots(positions, active)
    count = robots.shape[0]
    places = np.empty((count, 2))
    for slot in range(count):
        places[slot, 0] = positions[robots[slot], 0]
        places[slot, 1] = positions[robots[slot], 1]
    parts = np.zeros((max(1, 2 * count), 4), dtype=np.int64)
    parts[0, 1] = count
    number = 1
    part = 0
    while part < number:
        first, last = parts[part, 0], parts[part, 1]
        if last - first > CELL_SIZE and keys[first] != keys[last - 1]:
            middle = _middle(keys, first, last)
            parts[part, 2] = number
            parts[number, 0], parts[number, 1], parts[number, 3] = first, middle, part
            parts[number + 1, 0], parts[number + 1, 1], parts[number + 1, 3] = middle, last, part
            number += 2
        part += 1
    parts = parts[:number].copy()
    boxes = np.empty((number, 4))
    for part in range(number - 1, -1, -1):
        _enclose(places, parts, part, boxes)
    return robots, places, parts, boxes


@kernel
def list_cells(world):
    """Indices of the parts that are cells; all hold about as many robots, so a share of them is a share of the work."""
    parts = world[2]
    cells = np.empty(parts.shape[0], dtype=np.int64)
    number = 0
    for part in range(parts.shape[0]):
        if parts[part, 2] == 0:
            cells[number] = part
            number += 1
    return cells[:number]


@kernel
def _enclose(places, parts, part, boxes):
    """Write the box around the robots of a part, whose halves have theirs."""
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    half = parts[part, 2]
    if half == 0:
        for slot in range(parts[part, 0], parts[part, 1]):
            low_x, high_x = min(low_x, places[slot, 0]), max(high_x, places[slot, 0])
            low_y, high_y = min(low_y, places[slot, 1]), max(high_y, places[slot, 1])
    else:
        low_x, high_x = min(boxes[half, 0], boxes[half + 1, 0]), max(boxes[half, 2], boxes[half + 1, 2])
        low_y, high_y = min(boxes[half, 1], boxes[half + 1, 1]), max(boxes[half, 3], boxes[half + 1, 3])
    boxes[part, 0], boxes[part, 1], boxes[part, 2], boxes[part, 3] = low_x, low_y, high_x, high_y


@kernel
def box_distance(boxes, part, x, y):
    """Squared distance from a point to a part's box [m^2]; never above that of a place in it, rounding included."""
    d_x = max(boxes[part, 0] - x, x - boxes[part, 2], 0.0)
    d_y = max(boxes[part, 1] - y, y - boxes[part, 3], 0.0)
    return d_x * d_x + d_y * d_y


@kernel
def find_near(world, cell, limit, stack, near):
    """List the slots that a robot of a cell may have within a distance, and some farther ones.

    Args:
        world: Cells.
        cell: One of the parts.
        limit: Square of the distance [m^2].
        stack: Workspace, int64, shape (SEARCH_DEPTH,).
        near: Slots to write, int64, shape (M,).

    Returns:
        How many were found; those of the cell itself are among them.
    """
    _, places, parts, boxes = world
    low_x, low_y, high_x, high_y = boxes[cell, 0], boxes[cell, 1], boxes[cell, 2], boxes[cell, 3]
    number = 0
    stack[0] = 0
    top = 1
    while top > 0:
        top -= 1
        part = stack[top]
        d_x = max(boxes[part, 0] - high_x, low_x - boxes[part, 2], 0.0)
        d_y = max(boxes[part, 1] - high_y, low_y - boxes[part, 3], 0.0)
        if d_x * d_x + d_y * d_y > limit:
            continue
        half = parts[part, 2]
        if half > 0:
            stack[top], stack[top + 1] = half, half + 1
            top += 2
            continue
        for slot in range(parts[part, 0], parts[part, 1]):
            if box_distance(boxes, cell, places[slot, 0], places[slot, 1]) <= limit:
                near[number] = slot
                number += 1
    return number


@kernel
def _closest_pair(world):
    """Squared distance of the two robots nearest to each other [m^2]; ``inf`` without a pair."""
    limit = np.inf
    _, places, parts, _ = world
    stack, near = np.empty(SEARCH_DEPTH, dtype=np.int64), np.empty(places.shape[0], dtype=np.int64)
    cells = list_cells(world)
    # Pairs within a cell first, so that the search around it need not go far.
    for cell in cells:
        for own in range(parts[cell, 0], parts[cell, 1]):
            for slot in range(parts[cell, 0], own):
                limit = min(limit, squared_distance(places, own, slot))
    for cell in cells:
        number = find_near(world, cell, limit, stack, near)
        for own in range(parts[cell, 0], parts[cell, 1]):
            for k in range(number):
                if near[k] < own:
                    limit = min(limit, squared_distance(places, own, near[k]))
    return limit


@kernel
def smallest_distance_of(positions, active):
    """Smallest distance between two active robots of one world [m]; ``inf`` without a pair.

    Args:
        positions: Positions [m], shape (N, 2) or (N, 3) with anything in the third column.
        active: Robots that exist, shape (N,).
    """
    if active.shape[0] > SMALL_TEAM:
        return np.sqrt(_closest_pair(make_cells(positions, active)))
    smallest = np.inf
    for i in range(active.shape[0]):
        for j in range(i):
            if active[i] and active[j]:
                smallest = min(smallest, squared_distance(positions, i, j))
    return np.sqrt(smallest)


@kernel
def squared_distance(places, slot, other):
    """Squared distance of two places, given by their rows [m^2]."""
    d_x, d_y = places[slot, 0] - places[other, 0], places[slot, 1] - places[other, 1]
    return d_x * d_x + d_y * d_y


@kernel
def extended(values, size):
    """Return an array with the same rows at its front and room for at least ``size`` of them."""
    if size <= values.shape[0]:
        return values
    longer = np.empty((max(size, 2 * values.shape[0]), values.shape[1]), dtype=values.dtype)
    longer[: values.shape[0]] = values
    return longer


@kernel
def pairs_within(positions, active, limit):
    """All pairs of active robots whose squared distance is at most ``limit`` [m^2].

    Args:
        positions: Positions [m], shape (N, 2) or (N, 3) with anything in the third column.
        active: Robots that exist, shape (N,).
        limit: Largest squared distance [m^2].

    Returns:
        Indices of the two robots of every pair, shape (P, 2).
    """
    count = active.shape[0]
    pairs = np.empty((2 * count, 2), dtype=np.int64)
    filled = 0
    if count <= SMALL_TEAM:
        for i in range(count):
            if active[i]:
                pairs = extended(pairs, filled + i)
                for j in range(i):
                    if active[j] and squared_distance(positions, i, j) <= limit:
                        pairs[filled, 0], pairs[filled, 1] = i, j
                        filled += 1
        return pairs[:filled]
    world = make_cells(positions, active)
    robots, places, parts, _ = world
    stack, near = np.empty(SEARCH_DEPTH, dtype=np.int64), np.empty(count, dtype=np.int64)
    for cell in list_cells(world):
        number = find_near(world, cell, limit, stack, near)
        for own in range(parts[cell, 0], parts[cell, 1]):
            pairs = extended(pairs, filled + number)
            for k in range(number):
                if near[k] < own and squared_distance(places, own, near[k]) <= limit:
                    pairs[filled, 0], pairs[filled, 1] = robots[own], robots[near[k]]
                    filled += 1
    return pairs[:filled]
