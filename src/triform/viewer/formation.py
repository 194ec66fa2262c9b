"""What a page shows of a team at one moment, and how it went so far."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from triform.geometry import assess, gabriel_graph, list_triangles, wrap_angle
from triform.types import BoolArray, FloatArray, IntArray

#: How long the way is that is drawn behind a robot [s].
TRAIL = 4.0


@dataclass(frozen=True, eq=False)
class Formation:
    """A team at one moment.

    Attributes:
        time: Time since the start [s].
        robots: Which robots exist, shape (M,).
        poses: Their poses in the world frame [m, m, rad], shape (M, 3).
        edges: Their Gabriel graph, as pairs of indices into ``robots``, shape (E, 2).
        lengths: Lengths of the edges [m], shape (E,).
        triangles: Its triangles, as indices into ``robots``, shape (K, 3).
        closed: Which of them have three edges within 10 % of d*, shape (K,).
        error: Mean relative edge error; ``NaN`` where there is no edge.
        strict: Whether the formation is a triangulation.
        compactness: Edges over the most that a team of this size can have; ``NaN`` for fewer than two.
    """

    time: float
    robots: IntArray
    poses: FloatArray
    edges: IntArray
    lengths: FloatArray
    triangles: IntArray
    closed: BoolArray
    error: float
    strict: bool
    compactness: float

    @classmethod
    def of(cls, time: float, poses: FloatArray, active: BoolArray, distance: float) -> Formation:
        """Return what robots at ``poses`` (N, 3), of which ``active`` (N,) exist, form with d* = ``distance`` [m]."""
        robots = np.flatnonzero(active)
        own = np.array(poses[robots])
        positions = np.ascontiguousarray(own[:, :2])
        graph = gabriel_graph(positions)
        edges = np.argwhere(np.triu(graph, 1))
        lengths = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
        triangles, closed = list_triangles(positions, graph, distance)
        quality = assess(positions, distance)
        return cls(
            time, robots, own, edges, lengths, triangles, closed, float(quality.edge_error), bool(quality.strict),
            float(quality.compactness),
        )  # fmt: skip


class Picture(NamedTuple):
    """What is drawn now.

    Attributes:
        formation: The team at its newest record.
        poses: Where its robots are drawn, shape (M, 3) [m, m, rad]: on the way there.
        trail: Where all robots were in the last records, the newest last, shape (T, N, 2) [m]; ``NaN`` where a robot
            did not exist.
    """

    formation: Formation
    poses: FloatArray
    trail: FloatArray


class Course(NamedTuple):
    """How a run went so far: one number per record, each of shape (T,).

    Attributes:
        time: Time since the start [s].
        error: Mean relative edge error.
        strict: Whether the formation was a triangulation.
        shortest: Length of the shortest edge [m].
        median: Median length of the edges [m].
        longest: Length of the longest edge [m].
        compactness: Edges over the most that a team of this size can have.
    """

    time: FloatArray
    error: FloatArray
    strict: FloatArray
    shortest: FloatArray
    median: FloatArray
    longest: FloatArray
    compactness: FloatArray

    @classmethod
    def of(cls, rows: list[FloatArray]) -> Course:
        """Return the course of records, each as ``course_row`` gives it."""
        return cls(*np.array(rows, dtype=np.float64).reshape(-1, len(cls._fields)).T)


def course_row(formation: Formation) -> FloatArray:
    """Return what a plot shows of a moment, shape (7,)."""
    lengths = formation.lengths
    edges = np.quantile(lengths, [0.0, 0.5, 1.0]) if len(lengths) else np.full(3, np.nan)
    return np.array([formation.time, formation.error, formation.strict, *edges, formation.compactness])


def between(before: FloatArray, after: FloatArray, share: float) -> FloatArray:
    """Return poses (M, 3) on the way from one to another, headings the shortest way round; ``share`` from 0 to 1."""
    way = after - before
    way[:, 2] = wrap_angle(way[:, 2])
    return np.asarray(before + share * way, dtype=np.float64)


def earlier_poses(before: Formation, after: Formation) -> FloatArray:
    """Return where the robots of ``after`` were before, shape (M, 3); newcomers where they are."""
    came_from = dict(zip(before.robots.tolist(), before.poses, strict=True))
    poses = [came_from.get(robot, pose) for robot, pose in zip(after.robots.tolist(), after.poses, strict=True)]
    return np.array(poses).reshape(-1, 3)


def stacked(records: list[FloatArray], robots: int) -> FloatArray:
    """Return records of shape (N, 2) with N up to ``robots`` as one array, shape (T, robots, 2); ``NaN`` elsewhere."""
    rows = np.full((len(records), robots, 2), np.nan)
    for row, record in zip(rows, records, strict=True):
        row[: len(record)] = record[:robots]
    return rows
