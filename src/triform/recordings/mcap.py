"""Runs as MCAP with Foxglove's schemas: written for viewers, and read as recordings.

A file holds one run: transforms from ``world`` to each robot on ``/tf``, the Gabriel graph on ``/formation``, walls and
pillars on ``/arena``, and, as JSON, exact poses with commands on ``/robots`` and measures on ``/measures``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from triform.evaluation.metrics import RunTable
from triform.evaluation.rollout import Trajectory
from triform.files import cannot_write
from triform.geometry import assess, gabriel_graph
from triform.recordings.description import Descriptions, RunSetting, Source, decode_description
from triform.recordings.formats import RawRun, frame_run, planar_pose
from triform.recordings.kept import KEY, KeptRuns
from triform.report.output import plain
from triform.simulation import Arena
from triform.types import FloatArray, TriformError, require

WORLD = "world"
#: Edges are blue at d* and red from this relative error on.
_WRONG, _RIGHT_COLOUR, _WRONG_COLOUR = 0.2, np.array([0.0, 0.447, 0.698]), np.array([0.835, 0.369, 0.0])
_NANOSECONDS = 10**9
_ROBOT = "robot"
_TRANSFORMS = ("foxglove.FrameTransforms", "foxglove.FrameTransform")


class McapWriter:
    """Writes one run."""

    def __init__(self, path: Path, file: IO[bytes], source: Source) -> None:
        """Begin a file.

        Args:
            path: Its name, for messages.
            file: Where to.
            source: Where poses come from.
        """
        import foxglove
        from foxglove.channels import FrameTransformsChannel, SceneUpdateChannel

        self._path = path
        # Channels close with their context.
        self._context = context = foxglove.Context()
        self._writer = foxglove.open_mcap(file, context=context)
        self._transforms = FrameTransformsChannel("/tf", context=context)
        self._formation, self._arena = (SceneUpdateChannel(name, context=context) for name in ("/formation", "/arena"))
        self._robots, self._measures = (foxglove.Channel(name, context=context) for name in ("/robots", "/measures"))
        self._descriptions = Descriptions(source)

    def add(self, trajectory: Trajectory, setting: RunSetting, measures: RunTable) -> None:
        """Write the run.

        Args:
            trajectory: The run, B = 1.
            setting: Its setting.
            measures: As ``RunWriter.add``.

        Raises:
            TriformError: The disk fails, or there is more than one run.
        """
        description = self._descriptions
        require(
            len(trajectory.poses) == 1 and not description.description.runs,
            f"{self._path} holds one run, because viewers play one; keep several in Parquet",
        )
        row = {name: column[0] for name, column in measures.items()}
        description.add(setting, trajectory.poses.shape[2], row)
        try:
            self._write(trajectory, setting)
        except OSError as error:
            raise cannot_write(self._path, error) from error

    def describe(self, settings: dict[str, Any]) -> None:
        """Say with which settings and controller the run was made; plain JSON values, for people."""
        self._descriptions.settings = settings

    def close(self) -> None:
        """Write the description and the end of the file.

        Raises:
            TriformError: The disk is full or fails.
        """
        try:
            text = self._descriptions.description.encode().decode()
            self._writer.write_metadata(KEY.decode(), {"description": text})
            self._writer.close()
        except (OSError, RuntimeError) as error:
            raise TriformError(f"cannot write {self._path}: {error}") from error

    def give_up(self) -> None:
        """Write nothing more, while the file is still open, which is deleted or has been closed."""
        with suppress(OSError, RuntimeError):
            self._writer.close()

    def _write(self, run: Trajectory, setting: RunSetting) -> None:
        from foxglove.messages import FrameTransform, FrameTransforms, SceneUpdate

        poses, active = run.poses[0], run.active[0]
        full, sensed = (
            assess(poses[..., :2], setting.distance, reach, active) for reach in (np.inf, 2.0 * setting.distance)
        )
        moments = [round(moment * _NANOSECONDS) for moment in run.time.tolist()]
        self._arena.log(SceneUpdate(entities=[_obstacles(setting.arena, moments[0])]), log_time=moments[0])
        for record, moment in enumerate(moments):
            there = np.flatnonzero(active[record])
            transforms = [
                FrameTransform(
                    timestamp=_stamp(moment),
                    parent_frame_id=WORLD,
                    child_frame_id=f"{_ROBOT}{robot}",
                    translation=_vector(*poses[record, robot, :2]),
                    rotation=_turn(poses[record, robot, 2]),
                )
                for robot in there
            ]
            self._transforms.log(FrameTransforms(transforms=transforms), log_time=moment)
            edges = _edges(poses[record, there, :2], setting.distance, moment)
            self._formation.log(SceneUpdate(entities=[edges]), log_time=moment)
            held = run.commands[0, record] if record < len(moments) - 1 else np.full_like(poses[record], np.nan)
            robots = [dict(zip(("robot", *_STATE), [int(i), *poses[record, i], *held[i]], strict=True)) for i in there]
            self._robots.log(plain({"robots": robots}), log_time=moment)
            found = {
                "formation_error": full.edge_error[record],
                "formation_error_sensed": sensed.edge_error[record],
                "edges": full.edges[record],
                "strict": full.strict[record],
                "compactness": full.compactness[record],
            }
            self._measures.log(plain(found), log_time=moment)


#: What ``/robots`` says of each: pose [m, m, rad], and the body twist held to the next record [m/s, m/s, rad/s].
_STATE = ("x", "y", "heading", "v_x", "v_y", "omega")


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


def _edges(places: FloatArray, distance: float, moment: int) -> Any:
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


def _obstacles(arena: Arena, moment: int) -> Any:
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


class McapRuns(KeptRuns):
    """The run of an MCAP file that ``McapWriter`` wrote."""

    def trajectory(self, run: int) -> Trajectory:
        """Read the run, B = 1, as ``KeptRuns.trajectory``; its commands are ``NaN``."""
        robots = self.description.runs[run].robots
        names = {f"{_ROBOT}{robot}": robot for robot in range(robots)}
        records: dict[float, FloatArray] = {}
        for time, transforms in _transforms(self._path):
            poses = records.setdefault(time, np.full((robots, 3), np.nan))
            for parent, child, pose in transforms:
                if parent != WORLD or child not in names:
                    raise TriformError(f"{self.label(run)}: there is a transform from {parent} to {child}")
                poses[names[child]] = pose
        if len(records) < 2:
            raise TriformError(f"{self.label(run)}: there are less than two records")
        moments = sorted(records)
        poses = np.stack([records[time] for time in moments])[None]
        unknown = np.full((1, len(moments) - 1, robots, 3), np.nan)
        return Trajectory(np.array(moments), poses, np.isfinite(poses[..., 0]), unknown)


def open_mcap_runs(path: Path) -> McapRuns | None:
    """Open an MCAP file of a kept run; ``None`` if it is another MCAP file.

    Raises:
        TriformError: The file is damaged.
    """
    with path.open("rb") as file, _readable(path):
        found = [each.metadata for each in _reader(file).iter_metadata() if each.name == KEY.decode()]
    if not found:
        return None
    description = decode_description(found[0].get("description", "").encode(), str(path))
    if len(description.runs) != 1:
        raise TriformError(f"{path} cannot be read: its description has {len(description.runs)} runs; it holds one")
    return McapRuns(path, description)


def read_mcap(path: Path) -> list[RawRun]:
    """Read the transforms of an MCAP file of others, as ``frame_run`` says.

    Raises:
        TriformError: The file is damaged, or has no transforms in Foxglove's schemas.
    """
    seen: dict[tuple[str, str], list[tuple[float, FloatArray]]] = {}
    for time, transforms in _transforms(path):
        for parent, child, pose in transforms:
            seen.setdefault((parent, child), []).append((time, pose))
    if not seen:
        raise TriformError(f"{path} has no messages of {' or '.join(_TRANSFORMS)}, from which poses are read")
    return [frame_run(str(path), seen)]


def _reader(file: IO[bytes]) -> Any:
    from mcap.reader import make_reader

    return make_reader(file, validate_crcs=True)


def _transforms(path: Path) -> Iterator[tuple[float, list[tuple[str, str, FloatArray]]]]:
    """Yield the time [s] of every message with transforms, and parent, child and pose (x, y, heading) of each."""
    kinds: dict[int, Any] = {}
    with path.open("rb") as file, _readable(path):
        for schema, _, message in _reader(file).iter_messages():
            if schema is None or schema.name not in _TRANSFORMS or schema.encoding != "protobuf":
                continue
            if schema.id not in kinds:
                kinds[schema.id] = _message_class(schema)
            decoded = kinds[schema.id].FromString(message.data)
            found = [
                (each.parent_frame_id, each.child_frame_id, planar_pose(each.translation, each.rotation))
                for each in (decoded.transforms if schema.name == _TRANSFORMS[0] else [decoded])
            ]
            yield message.log_time / _NANOSECONDS, found


def _message_class(schema: Any) -> Any:
    """Return the class of messages of a protobuf schema, which holds its own definition."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    files = {each.name: each for each in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file}
    pool = descriptor_pool.DescriptorPool()

    def add(name: str) -> None:
        if name in files:
            file = files.pop(name)
            for other in file.dependency:
                add(other)
            pool.Add(file)

    for name in list(files):
        add(name)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Say in one sentence why an MCAP file cannot be read."""
    try:
        yield
    except (TriformError, OSError, ModuleNotFoundError):
        raise
    except Exception as error:  # noqa: BLE001 - a damaged file fails in whatever way its compression has
        raise TriformError(f"{path} cannot be read: {str(error).partition(chr(10))[0]}") from None
