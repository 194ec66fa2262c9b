"""Compiled scans of whole teams at one instant: who looks at whom, in a ``Scene``, along ``ScanRays``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from triform.geometry.cells import SEARCH_DEPTH, SMALL_TEAM, find_near, list_cells, make_cells
from triform.kernels import kernel
from triform.simulation.body_kernels import body_of
from triform.simulation.ray_kernels import see_box, see_circle, see_wall, sight_reach


@kernel(inline="always")
def _see_robot(i: int, j: int, poses: Any, axes: Any, body: Any, limit: float, scan: Any, row: Any) -> None:
    """Cast the scan of robot i at robot j with its ``body`` unless it is farther than ``limit`` [m^2]."""
    dx = poses[j, 0] - poses[i, 0]
    dy = poses[j, 1] - poses[i, 1]
    if dx * dx + dy * dy > limit:
        return
    cos, sin = axes[i, 0], axes[i, 1]
    x, y = cos * dx + sin * dy - scan.x, cos * dy - sin * dx - scan.y
    if body.is_circle:
        see_circle(x, y, body.half_length, scan, row)
    else:
        turned_cos = axes[j, 0] * cos + axes[j, 1] * sin
        turned_sin = axes[j, 1] * cos - axes[j, 0] * sin
        see_box(x, y, turned_cos, turned_sin, body, scan, row)


@kernel
def _see_arena(i: int, poses: Any, axes: Any, walls: Any, pillars: Any, scan: Any, row: Any) -> None:
    """Cast the scan of robot i at walls and pillars."""
    cos, sin = axes[i, 0], axes[i, 1]
    for w in range(walls.shape[0]):
        x1, y1 = walls[w, 0] - poses[i, 0], walls[w, 1] - poses[i, 1]
        x2, y2 = walls[w, 2] - poses[i, 0], walls[w, 3] - poses[i, 1]
        see_wall(
            cos * x1 + sin * y1 - scan.x, cos * y1 - sin * x1 - scan.y,
            cos * x2 + sin * y2 - scan.x, cos * y2 - sin * x2 - scan.y, scan, row,
        )  # fmt: skip
    for p in range(pillars.shape[0]):
        dx, dy = pillars[p, 0] - poses[i, 0], pillars[p, 1] - poses[i, 1]
        see_circle(cos * dx + sin * dy - scan.x, cos * dy - sin * dx - scan.y, pillars[p, 2], scan, row)


@kernel
def find_axes(poses: Any, axes: Any) -> None:
    """Write the directions (cosine, sine) of the headings of all robots, shape (N, 2)."""
    for i in range(poses.shape[0]):
        axes[i, 0] = math.cos(poses[i, 2])
        axes[i, 1] = math.sin(poses[i, 2])


@kernel
def cast_robot(i: int, poses: Any, active: Any, scene: Any, scan: Any, axes: Any, row: Any) -> None:
    """Cast the instantaneous, noiseless scan of robot i into ``row``, shape (R,); arguments as ``cast_world``.

    ``axes`` must be those of ``find_axes``.
    """
    body, walls, pillars = scene
    limit = sight_reach(scan, body) ** 2
    row[:] = math.inf
    for j in range(active.shape[0]):
        if j != i and active[j]:
            _see_robot(i, j, poses, axes, body_of(body, j), limit, scan, row)
    if walls.shape[0] + pillars.shape[0] > 0:
        _see_arena(i, poses, axes, walls, pillars, scan, row)


@kernel
def cast_world(poses: Any, active: Any, scene: Any, scan: Any, axes: Any, out: Any) -> None:
    """Cast the instantaneous, noiseless scans of one small team by looking at everybody; allocates nothing.

    Args:
        poses: World-frame poses, shape (N, 3) [m, m, rad]; rows of inactive robots are not used.
        active: Which robots exist, shape (N,).
        scene: ``Scene``: the robots' outlines, walls and pillars.
        scan: ``ScanRays``: the LiDAR of every robot.
        axes: Workspace, shape (N, 2).
        out: Ranges, shape (N, R), overwritten [m]; ``+inf`` for inactive robots. Any floating type.
    """
    find_axes(poses, axes)
    for i in range(active.shape[0]):
        if active[i]:
            cast_robot(i, poses, active, scene, scan, axes, out[i])
        else:
            out[i] = math.inf


@kernel
def cast_cells(world: Any, cells: Any, poses: Any, axes: Any, scene: Any, scan: Any, out: Any) -> None:
    """``cast_world`` for the robots in some ``cells`` of a world.

    Poses and axes come in the order of the slots, shapes (M, 3) and (M, 2), and ``out`` is in that of the robots: who
    is near in space is then near in memory, which counts where a team outgrows the caches.
    """
    robots, _, parts, _ = world
    _, walls, pillars = scene
    limit = sight_reach(scan, scene.body) ** 2
    stack, near = np.empty(SEARCH_DEPTH, dtype=np.int64), np.empty(robots.shape[0], dtype=np.int64)
    for cell in cells:
        number = find_near(world, cell, limit, stack, near)
        for own in range(parts[cell, 0], parts[cell, 1]):
            row = out[robots[own]]
            row[:] = math.inf
            for k in range(number):
                if near[k] != own:
                    body = body_of(scene.body, robots[near[k]])
                    _see_robot(own, near[k], poses, axes, body, limit, scan, row)
            if walls.shape[0] + pillars.shape[0] > 0:
                _see_arena(own, poses, axes, walls, pillars, scan, row)


@kernel
def sort_poses(world: Any, poses: Any) -> tuple[Any, Any]:
    """Poses (M, 3) and axes (M, 2) in the order of the slots."""
    robots = world[0]
    in_slots = np.empty((robots.shape[0], 3))
    for slot in range(robots.shape[0]):
        for column in range(3):
            in_slots[slot, column] = poses[robots[slot], column]
    axes = np.empty((robots.shape[0], 2))
    find_axes(in_slots, axes)
    return in_slots, axes


@kernel
def cast_worlds(poses: Any, active: Any, scene: Any, scan: Any, out: Any, first: int, last: int) -> None:
    """``cast_world`` for the worlds ``first <= b < last``: every per-robot array gains a leading axis B."""
    axes = np.empty((poses.shape[1], 2))
    for b in range(first, last):
        if poses.shape[1] <= SMALL_TEAM:
            cast_world(poses[b], active[b], scene, scan, axes, out[b])
            continue
        for i in range(active.shape[1]):
            if not active[b, i]:
                out[b, i] = math.inf
        world = make_cells(poses[b], active[b])
        in_slots, slot_axes = sort_poses(world, poses[b])
        cast_cells(world, list_cells(world), in_slots, slot_axes, scene, scan, out[b])
