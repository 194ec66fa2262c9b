"""ROS 2 bags, of MCAP or SQLite, read without ROS: odometry or poses of robots by their namespaces, or transforms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from triform.recordings.formats import RawRun, frame_run, make_track, planar_pose
from triform.types import FloatArray, TriformError

#: What a bag's folder holds beside its messages.
METADATA = "metadata.yaml"
#: Types of messages from which poses are read; the first one that a bag has is taken.
_ODOMETRY, _POSE, _TRANSFORMS = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage"
_NANOSECONDS = 10**9


def read_bag(folder: Path) -> list[RawRun]:
    """Read a bag as one run.

    A robot is a topic of ``Odometry``, or of ``PoseStamped`` if there is none, and is called after its namespace. If
    there is neither, robots are frames of ``/tf``, as ``frame_run`` says. Times are those in the headers.

    Raises:
        TriformError: The folder is no readable bag, holds no poses, a namespace has two topics of poses, or poses are
            in different frames.
    """
    if not (folder / METADATA).is_file():
        raise TriformError(f"{folder} is a folder without {METADATA}; the folder of a ROS 2 bag has one")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    try:
        with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            for kind in (_ODOMETRY, _POSE):
                chosen = [each for each in reader.connections if each.msgtype == kind and each.msgcount > 0]
                if chosen:
                    return [_robots(folder, reader, chosen, kind)]
            chosen = [each for each in reader.connections if each.msgtype == _TRANSFORMS and each.topic == "/tf"]
            if chosen:
                return [frame_run(str(folder), _frames(reader, chosen))]
    except (TriformError, ModuleNotFoundError):
        raise
    except Exception as error:  # noqa: BLE001 - a damaged bag fails in whatever way its storage has
        raise TriformError(f"{folder} cannot be read: {str(error).partition(chr(10))[0]}") from None
    raise TriformError(f"{folder} has no topics of {_ODOMETRY} or {_POSE}, and no /tf, from which poses are read")


def _robots(folder: Path, reader: Any, connections: Sequence[Any], kind: str) -> RawRun:
    """Return the run of robots with a topic of poses each."""
    names = _names(folder, sorted({each.topic for each in connections}), kind)
    seen: dict[str, list[tuple[float, FloatArray]]] = {topic: [] for topic in names}
    frames: dict[str, str] = {}
    for connection, stamp, data in reader.messages(connections=connections):
        message = reader.deserialize(data, kind)
        frames.setdefault(message.header.frame_id, connection.topic)
        pose = message.pose.pose if kind == _ODOMETRY else message.pose
        seen[connection.topic].append((_moment(message.header, stamp), planar_pose(pose.position, pose.orientation)))
    if len(frames) > 1:
        (one, first), (other, second), *_ = frames.items()
        raise TriformError(
            f"{folder}: poses on {first} are in the frame {one!r} and those on {second} in {other!r}; poses of all "
            "robots in one frame are needed"
        )
    tracks = {
        names[topic]: make_track(
            f"{folder}: robot {names[topic]}", *(np.array(each) for each in zip(*rows, strict=True))
        )
        for topic, rows in seen.items()
    }
    return RawRun(str(folder), tracks)


def _names(folder: Path, topics: Sequence[str], kind: str) -> dict[str, str]:
    """Return the robots by their topics: its namespace, such as ``robot1`` of ``/robot1/odom``.

    Raises:
        TriformError: A namespace lies in that of another topic, so that both may be of one robot.
    """
    names = {topic: topic.rpartition("/")[0].strip("/") for topic in topics}
    for one, outer in names.items():
        for other, inner in names.items():
            if one != other and f"{inner}/".startswith(f"{outer}/" if outer else ""):
                raise TriformError(
                    f"{folder}: the topics {one} and {other} of {kind} are in one namespace; one for each robot is "
                    "needed"
                )
    return {topic: name or topic.strip("/") for topic, name in names.items()}


def _frames(reader: Any, connections: Sequence[Any]) -> Mapping[tuple[str, str], Sequence[tuple[float, FloatArray]]]:
    """Return times and poses of every frame in its parent, by parent and child."""
    seen: dict[tuple[str, str], list[tuple[float, FloatArray]]] = {}
    for _, stamp, data in reader.messages(connections=connections):
        for each in reader.deserialize(data, _TRANSFORMS).transforms:
            pose = planar_pose(each.transform.translation, each.transform.rotation)
            seen.setdefault((each.header.frame_id, each.child_frame_id), []).append((_moment(each.header, stamp), pose))
    return seen


def _moment(header: Any, stamp: int) -> float:
    """Return the time of a header [s], or where it has none that at which the message was recorded [ns]."""
    moment = header.stamp.sec * _NANOSECONDS + header.stamp.nanosec
    return float(moment or stamp) / _NANOSECONDS
