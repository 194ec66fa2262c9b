"""Whether robots fit into an arena: starts that do not are refused, and a robot that joins is placed where it does."""

from __future__ import annotations

import numpy as np

from triform.simulation import Arena, SimulatedTeam, World, sample_addition
from triform.types import SENSING_RANGE, BoolArray, FloatArray, TriformError

#: Random places that are tried for a robot that joins.
_DRAWS = 1000


def walled_off(first: FloatArray, second: FloatArray, arena: Arena) -> BoolArray:
    """Tell between which points a wall stands.

    Args:
        first: Points in the world frame [m], shape (..., 2).
        second: As ``first``.
        arena: Walls; pillars separate no robots.

    Returns:
        Whether the straight line between the two crosses a wall, shape (...).
    """
    first, second = first[..., None, :], second[..., None, :]
    begin, end = arena.walls[:, :2], arena.walls[:, 2:]
    apart = _side(begin, end, first) * _side(begin, end, second) < 0
    # A line through the end of a wall counts, so that none slips through the corner of a room.
    within = _side(first, second, begin) * _side(first, second, end) <= 0
    return np.asarray((apart & within).any(axis=-1), dtype=np.bool_)


def blocked_starts(world: World) -> BoolArray:
    """Tell which worlds hold a team that the arena touches or, with a wall, separates from its first robot.

    Args:
        world: Worlds in which nothing has moved yet.

    Returns:
        Shape (B,).
    """
    positions = world.poses[..., :2]
    separated = walled_off(positions[:, :1], positions, world.arena).any(axis=-1)
    return np.asarray(world.hit_arena | separated, dtype=np.bool_)


def sample_clear_addition(
    world: SimulatedTeam, index: int, rng: np.random.Generator, distance: float = 1.0
) -> FloatArray:
    """Return a pose for a robot that joins world ``index``, clear of walls and pillars.

    Poses of ``sample_addition`` are drawn until the arena does not overlap the footprint and no wall stands between
    the newcomer and at least one robot within 2 d*, so that it is in the same room.

    Args:
        world: Worlds with their arena and kind of robots.
        index: Which of them.
        rng: Source of randomness.
        distance: Prescribed neighbour distance d* [m].

    Returns:
        Pose, shape (3,).

    Raises:
        TriformError: No such pose turned up.
    """
    poses, active = world.poses[index], world.active[index]
    others = poses[active, :2]
    for _ in range(_DRAWS):
        pose = sample_addition(poses, active, rng, distance)
        near = others[np.linalg.norm(others - pose[:2], axis=-1) <= SENSING_RANGE * distance]
        reachable = not walled_off(pose[:2], near, world.arena).all()
        if reachable and not World(pose[None, None], world.newcomer, world.arena, [0]).hit_arena[0]:
            return pose
    raise TriformError(
        f"no place for a new robot in the arena {world.arena.name!r}: walls or pillars blocked {_DRAWS} random ones"
    )


def _side(begin: FloatArray, end: FloatArray, point: FloatArray) -> FloatArray:
    """Positive where ``point`` lies left of the line from ``begin`` to ``end``, negative right of it."""
    along, across = end - begin, point - begin
    return np.asarray(along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0], dtype=np.float64)
