"""Runs as MCAP with Foxglove's schemas: written for viewers, and read as recordings.

A file holds one run: transforms from ``world`` to each robot on ``/tf``, the Gabriel graph on ``/formation``, walls and
pillars on ``/arena``, and, as JSON, exact poses with commands on ``/robots`` and measures on ``/measures``. Where scans
are recorded, ``/robot0/scan`` and ``/robot0/map`` have those of each robot and the occupancy maps that they make.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from triform.control import view_maps, weights_folder
from triform.evaluation.metrics import RunTable
from triform.evaluation.rollout import Trajectory
from triform.evaluation.senses import Senses
from triform.files import cannot_write
from triform.geometry import assess
from triform.policy import read_spec
from triform.recordings import foxglove_messages as messages
from triform.recordings.description import Descriptions, RunSetting, Source, decode_description
from triform.recordings.formats import RawRun, frame_run, planar_pose
from triform.recordings.kept import KEY, KeptRuns
from triform.report.output import plain
from triform.types import ConfigurationError, FloatArray, TriformError, require

_NANOSECONDS = 10**9
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
        from foxglove.messages import FrameTransforms, SceneUpdate

        poses, active = run.poses[0], run.active[0]
        full, sensed = (
            assess(poses[..., :2], setting.distance, reach, active) for reach in (np.inf, 2.0 * setting.distance)
        )
        moments = [round(moment * _NANOSECONDS) for moment in run.time.tolist()]
        firsts = np.cumsum([0, *(each.robots for each in run.senses)]).tolist()
        sensed_topics = [
            _SensedTopics(each, first, setting.distance, self._context)
            for each, first in zip(run.senses, firsts, strict=False)
        ]
        self._arena.log(SceneUpdate(entities=[messages.obstacles(setting.arena, moments[0])]), log_time=moments[0])
        for record, moment in enumerate(moments):
            there = np.flatnonzero(active[record])
            transforms = [messages.transform(robot, poses[record, robot], moment) for robot in there.tolist()]
            self._transforms.log(FrameTransforms(transforms=transforms), log_time=moment)
            edges = messages.edges(poses[record, there, :2], setting.distance, moment)
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
            for each in sensed_topics:
                each.log(record, float(run.time[record]))


class _SensedTopics:
    """Topics of the scans and occupancy maps of the robots of one kind."""

    def __init__(self, senses: Senses, first: int, distance: float, context: Any) -> None:
        """Open them; the first robot has number ``first``, and d* is a distance [m]."""
        from foxglove.channels import GridChannel, LaserScanChannel

        self._senses, self._first, self._distance = senses, first, distance
        self._spec = read_spec(weights_folder(None))
        topics = [f"/{messages.robot_frame(first + index)}" for index in range(senses.robots)]
        self._scans = [LaserScanChannel(f"{topic}/scan", context=context) for topic in topics]
        self._maps = [GridChannel(f"{topic}/map", context=context) for topic in topics]

    def log(self, record: int, time: float) -> None:
        """Write what was sensed at a record, and its time [s]."""
        view, moment = self._senses.view(record, time), round(time * _NANOSECONDS)
        there = np.flatnonzero(view.active[0]).tolist()
        for index in there:
            moved = None if view.odometry is None else view.odometry[0, index]
            ranges = view.scans.ranges[0, index]
            shown = messages.laser_scan(self._first + index, view.scans.config, ranges, moved, moment)
            self._scans[index].log(shown, log_time=moment)
        # LiDARs that see less far than the policy looks, or whose rays are too far apart, give no map.
        with suppress(ConfigurationError):
            maps, config = view_maps(view, self._spec, self._distance)
            for index in there:
                grid = messages.occupancy_grid(self._first + index, maps[0, index], config.cell, moment)
                self._maps[index].log(grid, log_time=moment)


#: What ``/robots`` says of each: pose [m, m, rad], and the body twist held to the next record [m/s, m/s, rad/s].
_STATE = ("x", "y", "heading", "v_x", "v_y", "omega")


class McapRuns(KeptRuns):
    """The run of an MCAP file that ``McapWriter`` wrote."""

    def trajectory(self, run: int, scans: bool = False) -> Trajectory:  # noqa: ARG002
        """Read the run, B = 1, as ``KeptRuns.trajectory``; its commands are ``NaN``, and its scans are for viewers."""
        robots = self.description.runs[run].robots
        names = {messages.robot_frame(robot): robot for robot in range(robots)}
        records: dict[float, FloatArray] = {}
        for time, transforms in _transforms(self._path):
            poses = records.setdefault(time, np.full((robots, 3), np.nan))
            for parent, child, pose in transforms:
                if parent != messages.WORLD or child not in names:
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
