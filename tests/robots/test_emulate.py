"""``triform emulate``: robots to drive without robots, and four of them driven by ``triform drive``."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from triform.evaluation import Trajectory, measure
from triform.robots.emulate import EmulateConfig, Emulation, drive_command
from triform.robots.ldrobot import MODELS, LidarPort
from triform.robots.robomaster import RoboMaster
from triform.simulation import HARDWARE, Footprint, LidarConfig, Mounting, Placement, cast_scans, profile_toml
from triform.types import ConfigurationError, TriformError

#: Loopback addresses that no other test run on this machine is likely to use.
_OWN = f"127.{100 + os.getpid() % 100}.{os.getpid() // 100 % 250}"
ADDRESSES = {"address": f"{_OWN}.1", "local_address": f"{_OWN}.101"}


@pytest.fixture
def emulation() -> Iterator[Emulation]:
    made = Emulation(EmulateConfig(robots=2, arena="room-6", latency=0.05, **ADDRESSES))
    yield made
    made.close()


def step_until(emulation: Emulation, done: Callable[[], bool], patience: float = 60.0) -> None:
    """Let emulated time run as fast as real time until something has happened."""
    began, start = time.monotonic(), emulation.time
    while not done():
        assert time.monotonic() - began < patience
        emulation.step()
        time.sleep(max(0.0, began + emulation.time - start - time.monotonic()))


def test_a_lidar_shows_the_world_around_its_robot(emulation: Emulation) -> None:
    config = EmulateConfig(robots=2)
    while emulation.time < 0.2:
        emulation.step()
    with LidarPort(emulation.lidars[1].path, config.model, config.model.scan_config(8.0)) as port:
        step_until(emulation, lambda: port.latest() is not None)
        turn = port.latest()
    assert turn is not None
    poses, everybody = emulation.poses[None], np.ones((1, 2), dtype=np.bool_)
    arena = EmulateConfig(arena="room-6").surroundings
    hits = np.empty((1, 2, port.scan.rays), np.int32)
    exact = cast_scans(poses, everybody, HARDWARE.footprint, arena, port.scan, hits=hits)[0, 1]
    wrong = ~(np.abs(turn.ranges - exact) < 0.05)
    # Rays that are dropped, and those at edges, where the nearest sample falls to the other side.
    assert wrong.mean() < 0.05
    # Robots wear tape, and walls are white: both noisy, and 50 apart.
    assert turn.intensities is not None
    usual = arena.levels(HARDWARE.lidar.brightness)[hits[0, 1]]
    assert set(np.unique(usual)) == {200.0, 250.0}
    assert (np.abs(turn.intensities - usual)[~wrong] < 25).mean() > 0.97
    assert turn.intensities.max() <= 255


def test_a_mounted_lidar_shows_the_same_world_to_a_driver_that_knows_its_mounting(tmp_path: Path) -> None:
    """It hangs upside down off the centre, and its zero points aside."""
    mounting = Mounting(0.05, -0.03, yaw=0.7, upright=False)
    path = tmp_path / "hanging.toml"
    path.write_text(profile_toml(replace(HARDWARE, mounting=mounting)), encoding="utf-8")
    config = EmulateConfig(robots=2, arena="room-6", latency=0.05, profile=str(path), **ADDRESSES)
    with closing(Emulation(config)) as emulation:
        while emulation.time < 0.2:
            emulation.step()
        with LidarPort(emulation.lidars[1].path, config.model, mounting=mounting) as port:
            step_until(emulation, lambda: port.latest() is not None)
            turn = port.latest()
        assert turn is not None
        poses, everybody = emulation.poses[None], np.ones((1, 2), dtype=np.bool_)
    scan = config.model.scan_config(7.5)
    shown = Placement(scan, mounting).from_base(turn.ranges)[0]
    exact = cast_scans(poses, everybody, HARDWARE.footprint, config.surroundings, scan)[0, 1]
    wrong = ~(np.abs(shown - exact) < 0.06)
    assert wrong.mean() < 0.08


def test_wheels_move_the_robot_and_its_odometry(emulation: Emulation) -> None:
    start = emulation.poses[0].copy()
    config = EmulateConfig(robots=2, **ADDRESSES)
    with RoboMaster(config.base_address(0), config.driver_address(0), watchdog=30.0) as base:
        base.drive(np.array([0.05, 0.08, 0.0]))
        step_until(emulation, lambda: bool(np.linalg.norm(emulation.poses[0, :2] - start[:2]) > 0.05))
        known = base.odometry(time.monotonic())
    moved = emulation.poses[0] - start
    direction = np.array([0.05, 0.08]) / np.hypot(0.05, 0.08)
    cos, sin = np.cos(start[2]), np.sin(start[2])
    forward, left = cos * moved[0] + sin * moved[1], cos * moved[1] - sin * moved[0]
    np.testing.assert_allclose([forward, left] / np.hypot(forward, left), direction, atol=0.02)
    assert known is not None
    np.testing.assert_allclose(known[:2], [forward, left], atol=0.03)
    np.testing.assert_allclose(emulation.poses[1], config.draw_start()[1])


@pytest.mark.parametrize(
    "setting",
    [
        {"robots": 0},
        {"robots": 51},
        {"seed": -1},
        {"index": -1},
        {"distance": np.nan},
        {"latency": -0.1},
        {"duration": 0.0},
        {"address": "192.168.2.1"},
        {"local_address": "here"},
    ],
)
def test_bad_settings_are_refused(setting: dict[str, object]) -> None:
    with pytest.raises(ConfigurationError):
        EmulateConfig(**setting)  # type: ignore[arg-type]


def test_robots_are_those_of_a_profile(tmp_path: Path) -> None:
    assert EmulateConfig().kind == HARDWARE
    assert EmulateConfig(lidar_model="ld14p").kind.lidar.noise == MODELS["ld14p"].noise
    path = tmp_path / "my robot.toml"
    path.write_text(profile_toml(replace(HARDWARE, footprint=Footprint.circle(0.3), lidar=LidarConfig(dropout=0.2))))
    config = EmulateConfig(profile=str(path), **ADDRESSES)
    assert config.kind.footprint == Footprint.circle(0.3)
    assert config.kind.lidar.noise == ()
    with closing(Emulation(config)) as emulation:
        words = shlex.split(drive_command(config, emulation, 0))
    assert words[words.index("--profile") + 1] == str(path)


def test_an_unknown_arena_is_refused() -> None:
    with pytest.raises(TriformError, match="there is no arena 'moon'"):
        Emulation(EmulateConfig(arena="moon", **ADDRESSES))


class Processes:
    """Commands of triform in processes of their own, with what they print in files."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._started: list[subprocess.Popen[bytes]] = []

    def start(self, *arguments: str) -> tuple[subprocess.Popen[bytes], Path]:
        path = self._folder / f"{len(self._started)}.txt"
        command = [sys.executable, "-m", "triform.cli", *arguments]
        with path.open("wb") as file:
            environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
            self._started.append(subprocess.Popen(command, stdout=file, stderr=file, env=environment))
        return self._started[-1], path

    def close(self) -> None:
        for process in self._started:
            if process.poll() is None:
                process.kill()
            process.wait()


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    started = Processes(tmp_path)
    yield started
    started.close()


def wait_for(happened: Callable[[], bool], what: Callable[[], str], patience: float = 300.0) -> None:
    end = time.monotonic() + patience
    while not happened():
        assert time.monotonic() < end, what()
        time.sleep(0.05)


def read_poses(path: Path, robots: int) -> Trajectory:
    """Read a recording of true poses."""
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    table = table[: len(table) // robots * robots].reshape(-1, robots, 5)
    poses = table[None, :, :, 2:]
    return Trajectory(table[:, 0, 0], poses, np.ones(poses.shape[:3], bool), np.zeros((1, len(table) - 1, robots, 3)))


@pytest.mark.slow
def test_four_robots_form_up_and_stop_when_they_are_told_to(processes: Processes, tmp_path: Path) -> None:
    truth = tmp_path / "true.csv"
    where = [f"--{name.replace('_', '-')}={value}" for name, value in ADDRESSES.items()]
    emulated, shown = processes.start("emulate", "--index", "12", "--record", str(truth), *where)
    wait_for(lambda: shown.read_text().count("triform drive") == 4 or emulated.poll() is not None, shown.read_text)
    commands = [shlex.split(line)[1:] for line in shown.read_text().splitlines() if line.startswith("triform drive")]
    assert len(commands) == 4, shown.read_text()
    driving = [processes.start(*command, "--watchdog", "2") for command in commands]
    for process, said in driving:
        wait_for(lambda: " Hz" in said.read_text() or process.poll() is not None, said.read_text)  # noqa: B023
        assert process.poll() is None, said.read_text()

    def emulate_for(seconds: float) -> Trajectory:
        begun = read_poses(truth, 4).time[-1]
        wait_for(lambda: read_poses(truth, 4).time[-1] > begun + seconds, shown.read_text)
        return read_poses(truth, 4)

    assert measure(emulate_for(13.0))["formation_error"][0] < 0.1

    for some in (driving[:1], driving[1:]):
        for process, _ in some:
            process.send_signal(signal.SIGTERM)
        for process, said in some:
            assert process.wait(60) == 143, said.read_text()
            assert "end of the scan to the base" in said.read_text()
        if len(some) == 1:
            # What is left of its motion by the drive's lag is over after a second.
            emulate_for(1.0)
            still = emulate_for(1.0)
            assert np.ptp(still.since(still.time[-1] - 1.0).poses[0, :, 0], axis=0).max() < 1e-3

    emulated.send_signal(signal.SIGTERM)
    assert emulated.wait(60) == 143
    assert "real-time factor" in shown.read_text()
