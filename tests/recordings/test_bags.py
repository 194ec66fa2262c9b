"""ROS 2 bags: what rosbags wrote, in either storage, is measured as the run that it was."""

from __future__ import annotations

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from tests.options import scenario
from triform.evaluation.metrics import measure
from triform.recordings.measure import MeasureConfig, run_measure
from triform.recordings.resample import read_recordings
from triform.types import TriformError

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
BEGAN = 1_700_000_000


def header(time, frame):
    nanoseconds = round(time * 1e9)
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=BEGAN + nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def quaternion(heading):
    return TYPES["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=np.sin(heading / 2), w=np.cos(heading / 2))


def pose_of(pose):
    point = TYPES["geometry_msgs/msg/Point"](x=pose[0], y=pose[1], z=0.1)
    return TYPES["geometry_msgs/msg/Pose"](position=point, orientation=quaternion(pose[2]))


def odometry(time, pose, frame="map", child="base_link"):
    zero = TYPES["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = TYPES["geometry_msgs/msg/TwistWithCovariance"](
        twist=TYPES["geometry_msgs/msg/Twist"](linear=zero, angular=zero), covariance=np.zeros(36)
    )
    placed = TYPES["geometry_msgs/msg/PoseWithCovariance"](pose=pose_of(pose), covariance=np.zeros(36))
    return TYPES["nav_msgs/msg/Odometry"](header=header(time, frame), child_frame_id=child, pose=placed, twist=twist)


def stamped(time, pose, frame="map"):
    return TYPES["geometry_msgs/msg/PoseStamped"](header=header(time, frame), pose=pose_of(pose))


def transforms(time, *placed):
    return TYPES["tf2_msgs/msg/TFMessage"](
        transforms=[
            TYPES["geometry_msgs/msg/TransformStamped"](
                header=header(time, parent),
                child_frame_id=child,
                transform=TYPES["geometry_msgs/msg/Transform"](
                    translation=TYPES["geometry_msgs/msg/Vector3"](x=pose[0], y=pose[1], z=0.0),
                    rotation=quaternion(pose[2]),
                ),
            )
            for parent, child, pose in placed
        ]
    )


def write(path, messages, plugin=StoragePlugin.MCAP):
    """Write (topic, time, message) into a bag; each is recorded a little after its stamp."""
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for topic, time, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            data = STORE.serialize_cdr(message, message.__msgtype__)
            writer.write(connections[topic], BEGAN * 10**9 + round(time * 1e9) + 3_000_000, data)
    return path


@pytest.fixture(scope="module")
def run():
    chosen = scenario(duration=8.0, distance=0.8)
    return chosen.run(chosen.sample_starts(4, 1, 11), "expert", 11)[0]


def records(run):
    return [(time, robot, run.poses[0, k, robot]) for k, time in enumerate(run.time.tolist()) for robot in range(4)]


def told(kind, run):
    if kind == "odometry":
        # Odometry is preferred to what else a bag holds.
        noise = [("/robot0/goal", 1.0, stamped(1.0, [50.0, 50.0, 0.0], "elsewhere"))]
        return noise + [(f"/robot{i}/odom", time, odometry(time, pose)) for time, i, pose in records(run)]
    if kind == "pose":
        return [(f"/fleet/robot{i}/pose", time, stamped(time, pose)) for time, i, pose in records(run)]
    sensor = [0.1, 0.0, 0.0]
    return [
        ("/tf", time, transforms(time, ("map", f"robot{i}/base", pose), (f"robot{i}/base", f"robot{i}/lidar", sensor)))
        for time, i, pose in records(run)
    ]


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize(
    ("kind", "name"), [("odometry", "robot{}"), ("pose", "fleet/robot{}"), ("transforms", "robot{}/base")]
)
def test_a_bag_is_measured_as_the_run_that_it_was(tmp_path, run, kind, name, plugin):
    path = write(tmp_path / "bag", told(kind, run), plugin)
    (recording,) = read_recordings(path)
    assert recording.robots == tuple(name.format(i) for i in range(4))
    np.testing.assert_allclose(recording.trajectory.positions, run.positions, atol=1e-6)
    turned = np.exp(1j * (recording.trajectory.poses[..., 2] - run.poses[..., 2]))
    np.testing.assert_allclose(turned, 1, atol=1e-6)
    found, wanted = run_measure(MeasureConfig((path,), distance=0.8)).runs, measure(run, 0.8)
    for each in ("formation_error", "converge_time", "strict_time", "min_distance"):
        np.testing.assert_allclose(found[each], wanted[each], atol=1e-5, err_msg=each)


@pytest.mark.parametrize(
    ("messages", "says"),
    [
        ([("/scan", 0.0, header(0.0, "x"))], "has no topics of nav_msgs/msg/Odometry or"),
        (
            [(f"/robot{i}/odom", 0.1, odometry(0.1, [i, 0, 0], f"robot{i}/odom")) for i in range(2)],
            "/robot0/odom are in the frame 'robot0/odom' and those on /robot1/odom in 'robot1/odom'",
        ),
        (
            [(topic, 0.1, odometry(0.1, [0, 0, 0])) for topic in ("/a/odom", "/a/odometry/filtered")],
            "the topics /a/odom and /a/odometry/filtered of nav_msgs/msg/Odometry are in one namespace",
        ),
        (
            [("/tf", 0.1, transforms(0.1, ("a/odom", "a/base", [0, 0, 0]), ("b/odom", "b/base", [0, 0, 0])))],
            "the frames 'a/odom' and 'b/odom' have no parent",
        ),
    ],
)
def test_what_says_not_where_robots_are_is_refused(tmp_path, messages, says):
    path = write(tmp_path / "bag", messages)
    with pytest.raises(TriformError, match=f"^[^\n]*{says}[^\n]*$"):
        read_recordings(path)


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_damaged_bags_and_other_folders_are_refused_in_a_sentence(tmp_path, run, plugin):
    with pytest.raises(TriformError, match=r"is a folder without metadata\.yaml"):
        read_recordings(tmp_path)
    path = write(tmp_path / "bag", told("odometry", run)[:200], plugin)
    (file,) = [each for each in path.iterdir() if each.name != "metadata.yaml"]
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(TriformError, match=r"bag cannot be read"):
        read_recordings(path)
    file.write_bytes(whole)
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: 3\n")
    with pytest.raises(TriformError, match=r"bag cannot be read"):
        read_recordings(path)
