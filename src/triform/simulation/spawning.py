"""Where runs begin: random starts, starts from a file, and places for a robot that joins."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from triform.files import refuse_device
from triform.simulation.spawn_kernels import first_valid, insert_in_turn, is_connected, linked_groups
from triform.types import SENSING_RANGE, BoolArray, FloatArray, TriformError, as_array, converted, require

#: Smallest distance between two centres at the start, and from a robot that joins to the others, at d* = 1 m [m].
#: It grows with d*, and below 1 m it stays, so that no footprints overlap.
SPACING = 0.5

#: The square does not shrink with d* below this [m]: closer together, hardly any placement keeps the spacing.
_SMALLEST_SCALE = 0.6
#: Up to this many robots whole placements are drawn until one is valid, which is exactly uniform over the valid
#: placements. Beyond, hardly any whole placement is valid (about 10 % at 13 robots, 0.01 % at 50).
_WHOLE_PLACEMENTS = 20
#: Nor is one if more pairs than this are expected to be too close: one in a thousand is at 7.
_CLOSE_PAIRS = 7.0
#: Up to this many robots all are placed again if the placement is not connected: one in 20 is at 1,000 robots, and
#: hardly any beyond.
_REDRAWN = 1000
_ROUNDS = 1000
_CANDIDATES = 64
_COLUMNS = ("run", "robot", "x", "y", "heading")


def square_side(robots: int, distance: float = 1.0) -> float:
    """Return the side of the square in which ``robots`` robots with the prescribed ``distance`` d* start [m]."""
    scale = max(distance, _SMALLEST_SCALE)
    if robots == 4:
        return 4.0 * scale
    return 5.0 * scale * math.sqrt(max(robots, 13) / 13)


def spacing_at(distance: float) -> float:
    """Return how far apart two centres at least start, if the prescribed distance is ``distance`` d* [m]."""
    return SPACING * max(distance, 1.0)


def _positions(robots: int, side: float, distance: float, rng: np.random.Generator) -> FloatArray | None:
    """Draw one valid placement, shape (N, 2) [m]; ``None`` if none turned up."""
    spacing, reach = spacing_at(distance), SENSING_RANGE * distance
    close_pairs = robots * (robots - 1) / 2 * math.pi * (spacing / side) ** 2
    for _ in range(_ROUNDS):
        if robots <= _WHOLE_PLACEMENTS and close_pairs <= _CLOSE_PAIRS:
            candidates = side * (rng.random((_CANDIDATES, robots, 2)) - 0.5)
            index = first_valid(candidates, spacing, reach)
            if index >= 0:
                return np.array(candidates[index])
        else:
            placed = _one_after_the_other(robots, side, spacing, reach, rng)
            if placed is not None and is_connected(placed, reach):
                return placed
    return None


def _one_after_the_other(
    robots: int, side: float, spacing: float, reach: float, rng: np.random.Generator
) -> FloatArray | None:
    """Draw a placement robot by robot, each uniform over what its predecessors leave free; ``None`` if it got stuck.

    In a large team there is always someone whom nobody happens to be near to. Who does not belong to the largest
    linked group is then placed again, uniformly over what is free and within reach of those in place.
    """
    placed = np.empty((robots, 2))
    candidates = side * (rng.random((4 * robots, 2)) - 0.5)
    if insert_in_turn(candidates, spacing, np.inf, side, np.arange(robots), placed) < robots:
        return None
    if robots > _REDRAWN:
        groups = linked_groups(placed, reach)
        missing = np.flatnonzero(groups != np.argmax(np.bincount(groups)))
        candidates = side * (rng.random((64 * len(missing), 2)) - 0.5)
        if insert_in_turn(candidates, spacing, reach, side, missing, placed) < len(missing):
            return None
    return placed


def sample_starts(
    robots: int, runs: int, seed: int, first: int = 0, side: float | None = None, distance: float = 1.0
) -> FloatArray:
    """Return random starts; a start is a function of ``(robots, seed, index)`` (``side`` and ``distance``) alone.

    Positions are uniform in a square around the origin such that no two centres are closer than 0.5 d* (and 0.5 m,
    for footprints do not shrink with d*) and the pairs within 2 d* connect everybody; headings are uniform. (Of more
    than 1,000 robots, which hardly ever are connected by chance, the few who are not are placed again where they are.)

    Args:
        robots: Robots in each run.
        runs: How many starts.
        seed: Seed, not negative.
        first: Index of the first start, so that a set can be made in parts.
        side: Side of the square [m]; by default 5 d* (4 d* for 4 robots, 5 d* sqrt(N / 13) beyond 13), and below
            d* = 0.6 m that of 0.6 m.
        distance: Prescribed neighbour distance d* [m].

    Returns:
        Poses (x, y, heading), shape (runs, robots, 3) [m, m, rad].

    Raises:
        ConfigurationError: If a count or the seed is negative, there is no robot, or a length is not positive.
        TriformError: If no valid start turns up because the square is too small or too large.
    """
    robots, runs, seed, first = (
        converted(name, value, int)
        for name, value in (("robots", robots), ("runs", runs), ("seed", seed), ("first", first))
    )
    distance, side = converted("distance", distance, float), converted("side", side, float | None)
    require(robots >= 1, f"{robots} robots asked for; at least 1 is needed")
    require(runs >= 0 and seed >= 0 and first >= 0, f"runs {runs}, seed {seed} or first {first} is negative")
    require(side is None or 0 < side < math.inf, f"side is {side} m; it must be positive and finite")
    require(0 < distance < math.inf, f"distance is {distance} m; it must be positive and finite")
    width = square_side(robots, distance) if side is None else side
    poses = np.empty((runs, robots, 3))
    for run in range(runs):
        rng = np.random.default_rng(np.random.SeedSequence([robots, seed, first + run]))
        positions = _positions(robots, width, distance, rng)
        if positions is None:
            raise TriformError(
                f"no start of {robots} robots found in a square of {width:.2f} m with centres at least "
                f"{spacing_at(distance):g} m apart and everybody linked within {SENSING_RANGE * distance:g} m"
            )
        poses[run, :, :2] = positions
        poses[run, :, 2] = rng.uniform(-np.pi, np.pi, robots)
    return poses


def sample_addition(
    poses: FloatArray, active: BoolArray, rng: np.random.Generator, distance: float = 1.0
) -> FloatArray:
    """Return a pose for a robot that joins one world.

    The place is uniform over the points at least 0.5 d* (and 0.5 m) from every robot and within 2 d* of at least one;
    the heading is uniform.

    Args:
        poses: Poses in the world frame, shape (N, 3) [m, m, rad].
        active: Which robots exist, shape (N,).
        rng: Source of randomness.
        distance: Prescribed neighbour distance d* [m].

    Returns:
        Pose, shape (3,).

    Raises:
        TriformError: If there is no robot to join or no free place.
    """
    distance = converted("distance", distance, float)
    present = as_array("poses", poses), as_array("flags of active robots", active, np.bool_)
    require(
        present[0].shape == (*present[1].shape, 3) and present[1].ndim == 1,
        f"poses of shape {present[0].shape} and active of shape {present[1].shape} given; (N, 3) and (N,) are needed",
    )
    others = present[0][present[1], :2]
    if len(others) == 0:
        raise TriformError("a robot cannot join a world that has no robots: there is nobody to be near to")
    spacing, reach = spacing_at(distance), SENSING_RANGE * distance
    low, high = others.min(axis=0) - reach, others.max(axis=0) + reach
    for _ in range(_ROUNDS):
        places = rng.uniform(low, high, (_CANDIDATES, 2))
        nearest = np.linalg.norm(places[:, None] - others, axis=-1).min(axis=1)
        valid = np.flatnonzero((nearest >= spacing) & (nearest <= reach))
        if len(valid):
            return np.array([*places[valid[0]], rng.uniform(-np.pi, np.pi)])
    raise TriformError(f"no free place for a new robot among {len(others)} robots")


def _read_csv(path: Path) -> FloatArray:
    """Read numbers of a CSV file, with or without the header, shape (rows, 5)."""
    rows: list[list[float]] = []
    with path.open(newline="", encoding="utf-8") as file:
        for line, cells in enumerate(csv.reader(file), start=1):
            names = [cell.strip() for cell in cells]
            if not any(names) or (not rows and tuple(names) == _COLUMNS):
                continue
            if len(names) != len(_COLUMNS):
                raise TriformError(f"{path}, line {line}: {len(names)} columns; {', '.join(_COLUMNS)} are needed")
            rows.append([])
            for column, cell in zip(_COLUMNS, names, strict=True):
                try:
                    rows[-1].append(float(cell))
                except ValueError:
                    raise TriformError(f"{path}, line {line}, column {column}: {cell!r} is not a number") from None
    return np.array(rows).reshape(-1, len(_COLUMNS))


def _read_npy(path: Path) -> FloatArray:
    try:
        values = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, MemoryError) as error:
        raise TriformError(f"{path} is not an .npy file of numbers: {error}") from None
    if values.ndim != 2 or values.shape[1] != len(_COLUMNS) or values.dtype.kind not in "fiu":
        raise TriformError(
            f"{path} holds {values.dtype} of shape {values.shape}; rows of {', '.join(_COLUMNS)} are needed"
        )
    return np.asarray(values, dtype=np.float64)


def load_starts(path: Path) -> list[FloatArray]:
    """Read explicit starts from ``.npy`` or ``.csv``, rows of run, robot, x, y, heading [m, m, rad].

    Rows may come in any order; the robots of each run must be 0 to N - 1, each once. N may differ between runs.

    Returns:
        Poses of every run in growing order of its number, each of shape (N, 3).

    Raises:
        TriformError: If the file cannot be read or a row is malformed; the row and column are named.
    """
    path = converted("starts", path, Path)
    if path.suffix not in (".npy", ".csv"):
        raise TriformError(f"{path} ends in {path.suffix!r}; starts are read from .npy or .csv")
    try:
        refuse_device(path)
        table = _read_npy(path) if path.suffix == ".npy" else _read_csv(path)
    except (OSError, UnicodeDecodeError) as error:
        raise TriformError(f"{path} cannot be read: {error}") from None
    if len(table) == 0:
        raise TriformError(f"{path} holds no starts; rows of {', '.join(_COLUMNS)} are needed")
    _check_rows(path, table)
    result = []
    for run in np.unique(table[:, 0]):
        rows = table[table[:, 0] == run]
        rows = rows[np.argsort(rows[:, 1], kind="stable")]
        if not np.array_equal(rows[:, 1], np.arange(len(rows))):
            raise TriformError(
                f"{path}, run {run:.0f}, column robot: robots {[int(robot) for robot in rows[:, 1]]} given; "
                f"0 to {len(rows) - 1}, each once, are needed"
            )
        result.append(np.ascontiguousarray(rows[:, 2:]))
    return result


def _check_rows(path: Path, table: FloatArray) -> None:
    """Refuse values that are not finite, and runs and robots that are no whole numbers from 0."""
    for column, name in enumerate(_COLUMNS):
        values = table[:, column]
        good = np.isfinite(values)
        if column < 2:
            good &= (values >= 0) & (values == np.floor(values))
        if not good.all():
            row = int(np.argmin(good))
            allowed = "a whole number from 0" if column < 2 else "a finite number"
            raise TriformError(f"{path}, row {row + 1}, column {name}: {values[row]} is not {allowed}")


def world_seeds(robots: int, seed: int, runs: Iterable[int], purpose: int = 1) -> list[np.random.SeedSequence]:
    """Return one seed per run for its noise; a function of (robots, seed, index) alone, like the starts.

    Args:
        robots: Number of robots N.
        seed: Seed of the whole evaluation.
        runs: Index of every run.
        purpose: Keeps streams for different uses apart; the starts themselves use none.
    """
    robots, seed = converted("robots", robots, int), converted("seed", seed, int)
    require(robots >= 0 and seed >= 0, f"robots {robots} or seed {seed} is negative")
    return [np.random.SeedSequence([robots, seed, int(index), purpose]) for index in runs]
