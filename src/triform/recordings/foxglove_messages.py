"""Messages in Foxglove's schemas: transforms, the graph, obstacles, scans and occupancy maps."""

from __future__ import annotations

from typing import Any

import numpy as np

from triform.geometry import body_to_world, gabriel_graph
from triform.simulation import Arena
from triform.types import FloatArray, MapArray, ScanConfig

#: Frame of all robots.
WORLD = "world"
#: Edges are blue at d* and red from this relative error on.
_WRONG, _RIGHT_COLOUR, _WRONG_COLOUR = 0.2, np.array([0.0, 0.447, 0.698]), np.array([0.835, 0.369, 0.0])
_NANOSECONDS = 10**9


def robot_frame(robot: int) -> str:
    """Return the frame of a robot."""
    return f"robot{robot}"


def transform(robot: int, pose: FloatArray, moment: int) -> Any:
    """Return where a robot is: its pose (3,) in the world [m, m, rad] at a moment [ns]."""
    from foxglove.messages import FrameTransform

    return FrameTransform(
        timestamp=_stamp(moment),
        parent_frame_id=WORLD,
        child_frame_id=robot_frame(robot),
        translation=_vector(*pose[:2]),
        rotation=_turn(pose[2]),
    )


def edges(places: FloatArray, distance: float, moment: int) -> Any:
    """Return the Gabriel graph of places (N, 2), coloured by how far each edge is from d* [m]."""
    from foxglove.messages import Color, LinePrimitive, LinePrimitiveLineType, SceneEntity

    edges = np.argwhere(np.triu(gabriel_graph(places), 1)) if len(places) > 1 else np.zeros((0, 2), np.int64)
    errors = np.abs(np.linalg.norm(places[edges[:, 0]] - places[edges[:, 1]], axis=1) - distance) / distance
    share = np.minimum(errors / _WRONG, 1.0)[:, None]
    blends = _RIGHT_COLOUR + share * (_WRONG_COLOUR - _RIGHT_COLOUR)
    colours = [Color(r=r, g=g, b=b, a=1.0) for r, g, b in blends.tolist()]
    lines = LinePrimitive(
        type=LinePrimitiveLineType.LineList,
        thickness=0.03,
        points=_points(places[edges].reshape(-1, 2)),
        colors=[colour for colour in colours for _ in range(2)],
    )
    return SceneEntity(id="graph", frame_id=WORLD, timestamp=_stamp(moment), lines=[lines])


def obstacles(arena: Arena, moment: int) -> Any:
    """Return walls and pillars as a scene."""
    from foxglove.messages import (
        Color,
        CylinderPrimitive,
        LinePrimitive,
        LinePrimitiveLineType,
        Pose,
        SceneEntity,
        Vector3,
    )

    dark = Color(r=0.2, g=0.2, b=0.2, a=1.0)
    walls = LinePrimitive(
        type=LinePrimitiveLineType.LineList, thickness=0.05, points=_points(arena.walls.reshape(-1, 2)), color=dark
    )
    pillars = [
        CylinderPrimitive(
            pose=Pose(position=_vector(x, y), orientation=_turn(0.0)),
            size=Vector3(x=2 * radius, y=2 * radius, z=0.5),
            bottom_scale=1.0,
            top_scale=1.0,
            color=dark,
        )
        for x, y, radius in arena.pillars.tolist()
    ]
    return SceneEntity(id=arena.name, frame_id=WORLD, timestamp=_stamp(moment), lines=[walls], cylinders=pillars)


def laser_scan(robot: int, scan: ScanConfig, ranges: FloatArray, moved: FloatArray | None, moment: int) -> Any:
    """Return a scan in the frame of its robot, from where the robot has been when it was taken.

    Args:
        robot: The robot.
        scan: Angles of the rays.
        ranges: Ranges [m], shape (R,); REP 117 for what is no range.
        moved: Pose of the robot now in its body frame at the moment of the scan [m, m, rad], shape (3,); ``None`` if it
            is not known, and the scan is then shown from where the robot is.
        moment: Now [ns].
    """
    from foxglove.messages import LaserScan, Pose

    x, y, turned = np.zeros(3) if moved is None else moved
    back = body_to_world(np.array([[-x, -y]]), -turned)[0]
    return LaserScan(
        timestamp=_stamp(moment),
        frame_id=robot_frame(robot),
        pose=Pose(position=_vector(*back), orientation=_turn(-turned)),
        start_angle=float(scan.angles[0]),
        end_angle=float(scan.angles[-1]),
        ranges=ranges.tolist(),
    )


def occupancy_grid(robot: int, occupied: MapArray, cell: float, moment: int) -> Any:
    """Return an occupancy map (H, W) with cells of a side [m] in the frame of its robot at a moment [ns].

    Rows of a ``Grid`` grow with y and its columns with x, those of our maps the other way round.
    """
    from foxglove.messages import Grid, PackedElementField, PackedElementFieldNumericType, Pose, Vector2

    rows, columns = occupied.shape
    return Grid(
        timestamp=_stamp(moment),
        frame_id=robot_frame(robot),
        pose=Pose(position=_vector(-rows * cell / 2, -columns * cell / 2), orientation=_turn(0.0)),
        column_count=rows,
        cell_size=Vector2(x=cell, y=cell),
        row_stride=rows,
        cell_stride=1,
        fields=[PackedElementField(name="occupied", offset=0, type=PackedElementFieldNumericType.Uint8)],
        data=np.ascontiguousarray(occupied.T).tobytes(),
    )


def _stamp(moment: int) -> Any:
    from foxglove.messages import Timestamp

    return Timestamp(*divmod(moment, _NANOSECONDS))


def _vector(x: float, y: float) -> Any:
    from foxglove.messages import Vector3

    return Vector3(x=float(x), y=float(y), z=0.0)


def _turn(heading: float) -> Any:
    from foxglove.messages import Quaternion

    return Quaternion(x=0.0, y=0.0, z=float(np.sin(heading / 2)), w=float(np.cos(heading / 2)))


def _points(places: FloatArray) -> list[Any]:
    from foxglove.messages import Point3

    return [Point3(x=float(x), y=float(y), z=0.0) for x, y in places]
