from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.simulators.walls import scattered, with_thick_walls
from triform.simulation import (
    HARDWARE,
    IDEAL,
    Arena,
    Drive,
    Footprint,
    cast_scans,
    get_arena,
    integrate,
    steer,
)
from triform.simulators.chassis import MAX_ACCELERATION, MAX_TURN_ACCELERATION
from triform.simulators.gazebo import GazeboError, GazeboServer, Installation, State, find_gazebo, write_world
from triform.types import FloatArray, ScanConfig, TriformError

ROBOTS, SPARE = 5, 2
PILLARS = get_arena("pillars")
#: Within it nobody touches anybody.
APART = np.array([[0.0, 0.0, 0.3], [1.0, 0.2, 1.0], [-1.0, 0.5, 2.0], [0.3, -1.2, -2.0], [2.4, 2.4, 1.0]])
LIMITS = Drive(max_acceleration=MAX_ACCELERATION, max_turn_acceleration=MAX_TURN_ACCELERATION)


@pytest.fixture(scope="module")
def server(gazebo: Installation) -> Iterator[GazeboServer]:
    with GazeboServer(IDEAL, PILLARS, ROBOTS, spare=SPARE) as server:
        yield server


def no_commands(server: GazeboServer) -> FloatArray:
    return np.zeros((len(server.active), 3))


def check_scans(state: State, footprint: Footprint, arena: Arena, config: ScanConfig, share: float = 1.0) -> None:
    """Compare with the built-in LiDAR; ``share`` of all ranges must be equal."""
    poses = np.where(state.active[:, None], state.poses, 0.0)
    expected = cast_scans(poses[None], state.active[None], footprint, with_thick_walls(arena), config)[0]
    assert state.ranges is not None
    assert state.ranges.shape == expected.shape
    assert state.ranges.dtype == np.float32
    with np.errstate(invalid="ignore"):
        equal = (state.ranges == expected) | (np.abs(state.ranges - expected) < 1e-5)
    assert equal.mean() >= share


@pytest.mark.parametrize(
    ("footprint", "config"),
    [
        (Footprint.box(0.32, 0.24), ScanConfig()),
        (Footprint.circle(0.3), ScanConfig(rays=667, range_min=0.1, range_max=8.0)),
        (Footprint.box(0.5, 0.2), ScanConfig(rays=1, angle_min=0.4, range_min=0.6, range_max=1.5)),
    ],
)
def test_scans_are_those_of_the_built_in_lidar(gazebo: Installation, footprint: Footprint, config: ScanConfig) -> None:
    profile = replace(IDEAL, footprint=footprint, lidar=replace(IDEAL.lidar, scan=config))
    rng = np.random.default_rng(4)
    with GazeboServer(profile, PILLARS, 8) as server:
        for _ in range(10):
            check_scans(server.reset(scattered(rng, 8), scan=True), footprint, PILLARS, config)
        pushed = server.step(rng.uniform(-0.4, 0.4, (8, 3)), 50)
        if not (pushed.touched or pushed.touched_arena):
            # Who accelerates rocks a little.
            check_scans(pushed, footprint, PILLARS, config, share=0.98)


def test_what_is_nearer_than_range_min_is_too_near(gazebo: Installation) -> None:
    profile = replace(IDEAL, lidar=replace(IDEAL.lidar, scan=ScanConfig(rays=4, range_min=0.5, range_max=1.0)))
    arena = Arena(walls=np.array([[-3.0, 0.4, 3.0, 0.4], [-3.0, -0.7, 3.0, -0.7]]))
    with GazeboServer(profile, arena, 1) as server:
        ranges = server.reset([[0.0, 0.0, 0.0]], scan=True).ranges
    assert ranges is not None
    # Backwards, right, forwards, left.
    np.testing.assert_allclose(ranges[0], [np.inf, 0.7, np.inf, -np.inf], atol=1e-3)


@pytest.mark.parametrize("lag", [0.0, 0.1])
def test_planar_drive_moves_as_the_built_in_world(gazebo: Installation, lag: float) -> None:
    commands = np.array([[0.3, 0.2, 0.5], [-0.2, 0.1, -1.0], [0.0, 0.0, 2.0]])
    limits = replace(LIMITS, lag=lag)
    poses, twists = APART[:3], np.zeros((3, 3))
    with GazeboServer(replace(IDEAL, drive=limits), Arena.open(), 3) as server:
        server.reset(poses)
        for k in range(20):
            turned = commands * (1 if k < 12 else -0.5)
            state = server.step(turned, 10, scan=False)
            for _ in range(10):
                poses, twists = steer(poses, twists, turned, limits, 0.01)
            np.testing.assert_allclose(state.twists, twists, atol=2e-3)
            np.testing.assert_allclose(state.poses[:, :2], poses[:, :2], atol=5e-3)
            np.testing.assert_allclose(np.angle(np.exp(1j * (state.poses - poses)[:, 2])), 0, atol=0.02)
    assert state.time == pytest.approx(2.0)


def test_commands_are_limited_as_in_the_built_in_world(gazebo: Installation) -> None:
    with GazeboServer(HARDWARE, Arena.open(), 1) as server:
        server.reset([[0.0, 0.0, 0.0]])
        state = server.step([[3.0, 0.05, 0.0]], 200, scan=False)
    np.testing.assert_allclose(state.twists[0], [0.1, 0.0083, 0.0], atol=5e-4)


def test_mecanum_wheels_reach_the_command(gazebo: Installation) -> None:
    command = np.array([[0.3, 0.3, 0.5]])
    with GazeboServer(IDEAL, Arena.open(), 1, drive="mecanum", time_step=0.001) as server:
        start = server.reset([[1.0, -2.0, 0.7]])
        moving = server.step(command, 500, scan=False)
        reached = [server.step(command, 10, scan=False).twists[0] for _ in range(100)]
        end = server.step(command, 0)
    np.testing.assert_allclose(np.mean(reached, axis=0), command[0], rtol=0.02)
    assert start.min_distance == np.inf
    expected = integrate(moving.poses, command, 1.0)
    np.testing.assert_allclose(end.poses[0, :2], expected[0, :2], atol=0.02)


@pytest.mark.parametrize(("drive", "time_step"), [("planar", 0.01), ("mecanum", 0.002)])
def test_runs_after_a_reset_and_in_a_fresh_process_are_the_same_to_the_bit(
    gazebo: Installation, drive: str, time_step: float
) -> None:
    # Two of them run into each other, one into a wall.
    poses = np.array([[0.0, 0.0, 0.3], [0.6, 0.05, -2.9], [2.6, 1.0, 0.0], [-1.5, -1.0, 2.0]])
    commands = np.array([[0.5, 0.0, 0.1], [0.5, 0.1, 0.0], [0.5, 0.0, 0.3], [0.2, 0.3, -0.5]])

    def run(server: GazeboServer) -> list[bytes]:
        states = [server.reset(poses)]
        for _ in range(15):
            states.append(server.step(commands, round(0.1 / time_step)))
        assert states[-1].touched or any(state.touched for state in states)
        assert any(state.touched_arena for state in states)
        return [
            b"".join(np.ascontiguousarray(values).tobytes() for values in (s.poses, s.twists, s.ranges, s.min_distance))
            for s in states[1:]
        ]

    def make() -> GazeboServer:
        return GazeboServer(IDEAL, get_arena("room-6"), 4, drive=drive, time_step=time_step)  # type: ignore[arg-type]

    # Two at once, which must not meddle with each other.
    with make() as one, make() as other:
        first = run(one)
        assert run(other) == first
        assert run(one) == first


def test_contacts_and_distances_are_seen_at_every_step(server: GazeboServer) -> None:
    poses = np.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0], [0.0, 3.6, np.pi / 2]])
    state = server.reset(poses)
    assert (state.touched, state.touched_arena) == (False, False)
    assert state.min_distance == pytest.approx(0.6)
    commands = no_commands(server)
    commands[0, 0] = 0.5
    state = server.step(commands, 30)
    assert not state.touched
    assert 0.45 < state.min_distance < 0.6
    # Into each other and away again: only a look at every step shows it.
    server.step(commands, 50)
    commands[0, 0] = -0.5
    state = server.step(commands, 100)
    assert state.touched
    assert state.min_distance == pytest.approx(0.32, abs=0.01)
    state = server.step(commands, 10)
    assert not state.touched
    commands[2, 0] = 0.5
    assert server.step(commands, 150).touched_arena
    # Bodies are solid.
    assert server.step(commands, 50).poses[2, 1] < 4 - 0.15


def test_robots_come_and_go(server: GazeboServer) -> None:
    server.reset(APART)
    before = server.step(no_commands(server), 10)
    assert server.active.tolist() == [True] * ROBOTS + [False] * SPARE
    assert np.isnan(before.poses[ROBOTS:]).all()
    assert before.ranges is not None
    assert np.isposinf(before.ranges[ROBOTS:]).all()
    new = server.add([0.0, 1.0, 0.5])
    assert new == ROBOTS
    commands = no_commands(server)
    commands[new] = [0.2, 0.0, 0.0]
    state = server.step(commands, 100)
    assert state.active[new]
    assert np.hypot(*(state.poses[new, :2] - [0.0, 1.0])) == pytest.approx(0.19, abs=0.02)
    check_scans(state, IDEAL.footprint, PILLARS, IDEAL.lidar.scan, share=0.98)
    server.remove(0)
    # Its place is free: another robot drives through it.
    assert server.add([0.0, 0.0, 0.0]) == 0
    server.remove(0)
    state = server.step(no_commands(server), 5)
    assert not state.active[0]
    assert state.min_distance > 0.5
    check_scans(state, IDEAL.footprint, PILLARS, IDEAL.lidar.scan)
    for robot in (0, -1, 99):
        with pytest.raises(TriformError, match="there is no robot"):
            server.remove(robot)
    for _ in range(2):
        server.add([-1.0, -1.5, 0.0] if server.active[0] else [1.5, -1.5, 0.0])
    with pytest.raises(TriformError, match="all 7 robots exist already"):
        server.add([0.0, 2.0, 0.0])


def test_bad_values_are_refused_in_one_sentence(server: GazeboServer) -> None:
    server.reset(APART)
    bad = no_commands(server)
    bad[1] = np.nan
    with pytest.raises(TriformError, match="of robot 1 is not finite"):
        server.step(bad, 1)
    with pytest.raises(TriformError, match="commands of shape"):
        server.step(np.zeros((2, 3)), 1)
    with pytest.raises(TriformError, match="-1 steps"):
        server.step(no_commands(server), -1)
    with pytest.raises(TriformError, match="poses of shape"):
        server.reset(np.zeros((99, 3)))
    with pytest.raises(TriformError, match="infinite"):
        server.reset(np.full((2, 3), np.inf))
    with pytest.raises(TriformError, match="cannot be placed"):
        server.add([0.0, np.nan, 0.0])
    for wrong in ({"drive": "wings"}, {"time_step": 0.0}, {"spare": -1}, {"timeout": -1.0}):
        with pytest.raises(TriformError):
            GazeboServer(IDEAL, PILLARS, 1, **wrong)  # type: ignore[arg-type]
    with pytest.raises(TriformError, match="too small for mecanum wheels"):
        write_world(replace(IDEAL, footprint=Footprint.circle(0.15)), PILLARS, 1, "mecanum", 0.01, "x.so")


def test_a_missing_or_broken_gazebo_is_one_sentence(
    gazebo: Installation, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    broken = tmp_path / "liblockstep.so"
    broken.write_bytes(b"not a library")
    # Without the plugin nobody answers; the connection lives as long as gzserver.
    with pytest.raises(GazeboError, match="has not answered for 3 s"):
        GazeboServer(IDEAL, PILLARS, 1, timeout=3.0, installation=replace(gazebo, plugin=broken))
    monkeypatch.setenv("TRIFORM_GAZEBO", str(tmp_path))
    assert find_gazebo() is None
    with pytest.raises(GazeboError, match="make gazebo"):
        GazeboServer(IDEAL, PILLARS, 1)


def test_a_killed_gazebo_is_one_sentence(gazebo: Installation) -> None:
    with GazeboServer(IDEAL, PILLARS, 1) as server:
        assert server.pid is not None
        os.kill(server.pid, signal.SIGKILL)
        with pytest.raises(GazeboError, match="Gazebo was ended by SIGKILL"):
            server.step(np.zeros((1, 3)), 1)
        with pytest.raises(GazeboError, match="has been closed"):
            server.step(np.zeros((1, 3)), 1)
        assert server.pid is None


def test_a_hung_gazebo_is_one_sentence(gazebo: Installation) -> None:
    with GazeboServer(IDEAL, PILLARS, 1) as server:
        assert server.pid is not None
        server._socket.settimeout(1.0)
        os.kill(server.pid, signal.SIGSTOP)
        # On a busy machine its threads go on for a moment.
        while not all("\nState:\tT" in each.read_text() for each in Path(f"/proc/{server.pid}/task").glob("*/status")):
            time.sleep(0.01)
        with pytest.raises(GazeboError, match="Gazebo has not answered"):
            server.step(np.zeros((1, 3)), 1)


def runs(pid: int) -> bool:
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("hung", [False, True])
def test_gazebo_ends_when_its_parent_is_killed(gazebo: Installation, hung: bool) -> None:
    code = """
import sys
from triform.simulators.gazebo import GazeboServer
from triform.simulation import IDEAL, Arena
server = GazeboServer(IDEAL, Arena.open(), 1)
print(server.pid, flush=True)
sys.stdin.read()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert runs(pid)
        if hung:
            os.kill(pid, signal.SIGSTOP)
        parent.kill()
        deadline = time.monotonic() + 30
        while runs(pid) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not runs(pid)


def test_nothing_listens_and_nothing_is_left(
    gazebo: Installation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def listening(pid: int | str) -> set[str]:
        """Local addresses of listening TCP sockets in the network namespace of a process."""
        tables = [Path(f"/proc/{pid}/net/{name}").read_text().splitlines()[1:] for name in ("tcp", "tcp6")]
        return {row.split()[1] for table in tables for row in table if row.split()[3] == "0A"}

    with GazeboServer(IDEAL, PILLARS, 1) as server:
        assert server.pid is not None
        inside = listening(server.pid)
        assert any(address.endswith(":2C51") for address in inside)  # port 11345
        assert not any(address.endswith(":2C51") for address in listening("self"))
        assert Path(f"/proc/{server.pid}/ns/net").readlink() != Path("/proc/self/ns/net").readlink()
        server.step(np.zeros((1, 3)), 1)
        assert list(tmp_path.iterdir()) == []
        pid = server.pid
    assert not runs(pid)
    assert list(tmp_path.iterdir()) == []
