"""A LiDAR's port and its emulator, joined by a pseudo-terminal, in real time."""

from __future__ import annotations

import os
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tests.robots.lidar_oracle import SlowPacket, slow_parse
from triform.robots.ldrobot import (
    LD19,
    LD20,
    LidarEmulator,
    LidarError,
    LidarModel,
    LidarPort,
    PacketParser,
    Packets,
)
from triform.robots.real import RealRobot
from triform.simulation import ROBOMASTER_EP, Arena, Drive, Mounting, Placement, cast_scans
from triform.types import ConfigurationError, FloatArray, ScanConfig, TriformError

#: How long anything may take on a busy machine [s].
PATIENCE = 30.0
Look = Callable[[FloatArray], FloatArray]


def emit(emulator: LidarEmulator, ranges: FloatArray) -> None:
    """Send returns that are all equally bright."""
    emulator.emit(ranges, np.full(ranges.shape, 200.0))


@contextmanager
def spinning(emulator: LidarEmulator, look: Look) -> Iterator[None]:
    """Turn an emulator in real time."""
    done = threading.Event()

    def spin() -> None:
        while not done.wait(0.005):
            emit(emulator, look(emulator.due(time.monotonic())))

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def flat(angles: FloatArray) -> FloatArray:
    return np.full(angles.shape, 1.5)


@pytest.mark.parametrize("model", [LD19, LD20])
def test_a_robot_stands_when_its_lidar_goes_blind_and_goes_on_when_it_sees_again(model: LidarModel) -> None:
    """Packets stay valid, but every distance becomes 0, as under a cover."""
    covered = threading.Event()
    said: list[str] = []
    sent: list[tuple[float, float]] = []

    def look(angles: FloatArray) -> FloatArray:
        return np.full(angles.shape, np.inf if covered.is_set() else 1.5)

    emulator = LidarEmulator(model, np.random.default_rng(12))
    with emulator, spinning(emulator, look), LidarPort(emulator.path, model) as port:
        robot = RealRobot(
            port, None, 0.02, 1, Drive(),
            placement=Placement(model.scan_config(2.0)), warn=said.append,
            on_sent=lambda step: sent.append((step.sent, float(step.command[0]))),
        )  # fmt: skip

        def drive_until(moves: bool) -> None:
            began = time.monotonic()
            while not sent or (sent[-1][1] > 0) != moves:
                assert time.monotonic() - began < PATIENCE
                robot.observe()
                robot.apply(np.full((1, 1, 3), 0.1), robot.control_period)

        drive_until(moves=True)
        covered.set()
        began = time.monotonic()
        drive_until(moves=False)
        # Four turns, of which the first saw something yet, and what a busy machine takes.
        assert sent[-1][0] - began < 4 * model.period + 1.0
        speeds = [speed for at, speed in sent if at > began]
        assert speeds == sorted(speeds, reverse=True)
        assert sum("until it sees again" in sentence for sentence in said) == 1
        covered.clear()
        drive_until(moves=True)


def failure_of(port: LidarPort) -> str:
    """What a port says when it has failed."""

    def wait_for_ever() -> None:
        while True:
            port.wait(time.monotonic(), PATIENCE)

    with pytest.raises(LidarError) as caught:
        wait_for_ever()
    with pytest.raises(LidarError):
        port.latest()
    return str(caught.value)


@pytest.mark.parametrize("mounting", [Mounting(), Mounting(yaw=0.7, upright=False)], ids=["upright", "upside down"])
@pytest.mark.parametrize("model", [LD19, LD20])
def test_what_the_simulator_casts_comes_out_of_the_port(model: LidarModel, mounting: Mounting) -> None:
    """Within the millimetre of the protocol and the angular step of the grid, left and right included."""
    poses = np.array([[[0.0, 0.0, 0.3], [1.0, 0.2, 1.0], [-0.4, 1.1, -2.0], [-1.0, -0.9, 0.0]]])
    active = np.ones((1, 4), dtype=bool)
    fine = ScanConfig(model.rays * 40, -np.pi, model.range_min, model.range_max)
    exact = cast_scans(poses, active, ROBOMASTER_EP, Arena.open(), fine)[0, 0]

    def look(angles: FloatArray) -> FloatArray:
        return np.asarray(exact[np.rint((angles + np.pi) / fine.angle_increment).astype(int) % fine.rays])

    rng = np.random.default_rng(1)
    with (
        LidarEmulator(model, rng, mounting=mounting) as emulator,
        spinning(emulator, look),
        LidarPort(emulator.path, model, mounting=mounting) as port,
    ):
        turn = port.wait(time.monotonic() + 0.1, PATIENCE)
        later = port.wait(turn.ended, PATIENCE)
        # A busy machine may hold the emulator up for so long that the terminal overflows.
        assert port.parser.packets > 0
    grid = cast_scans(poses, active, ROBOMASTER_EP, Arena.open(), port.scan)[0, 0]
    around = np.arange(-40, 41) + 40 * np.arange(model.rays)[:, None]
    near = np.minimum(exact[around % fine.rays].min(axis=1), grid)
    far = np.maximum(exact[around % fine.rays].max(axis=1), grid)
    for ranges in (turn.ranges, later.ranges):
        measured = ~np.isnan(ranges)
        assert measured.mean() > 0.5
        assert ((ranges >= near - 1e-3) & (ranges <= far + 1e-3))[measured].all()
        assert np.isfinite(ranges).sum() > 40
    assert turn.started < turn.ended <= later.started + 0.02
    assert later.ended <= time.monotonic()


def test_the_emulator_sends_plausible_packets() -> None:
    emulator = LidarEmulator(LD20, np.random.default_rng(2), mounting=Mounting(yaw=0.5))
    with emulator, emulator.path.open("rb", buffering=0) as terminal:
        angles, stream = [], b""
        assert emulator.due(100.0).shape == (0,)
        for now in 100 + np.arange(0.0, 4.0, 0.01):
            angles.append(emulator.due(now))
            emit(emulator, np.where(np.cos(angles[-1]) > 0, 1.234, np.inf))
            stream += terminal.read(4096) if len(angles) > 1 else b""
    packets = slow_parse(stream)
    flat_angles = np.concatenate(angles)
    assert abs(len(flat_angles) - 3.99 * 4000) <= 1
    assert len(stream) == 47 * len(packets)
    assert len(packets) >= len(flat_angles) // 12 - 4
    assert np.diff([packet.timestamp for packet in packets]) % 30000 == pytest.approx(3, abs=0)
    assert np.mean([packet.speed for packet in packets]) == pytest.approx(2160, rel=0.02)
    decoded = np.concatenate([decode(packet) for packet in packets])
    sent = flat_angles[: len(decoded)]
    np.testing.assert_allclose(np.exp(1j * (0.5 - decoded)), np.exp(1j * sent), atol=1e-9)
    steps = np.mod(np.diff(decoded), 2 * np.pi)
    np.testing.assert_allclose(steps, np.radians(0.54), rtol=0.1)
    values = np.array([sample for packet in packets for sample in packet.samples])
    assert set(values[np.cos(sent) > 0, 0]) == {1234}
    assert not values[np.cos(sent) < 0].any()
    assert (values[np.cos(sent) > 0, 1] > 100).all()


def decode(packet: SlowPacket) -> FloatArray:
    """Clockwise angles of a packet's samples [rad]."""
    return np.radians(packet.start_angle + np.arange(12) * ((packet.end_angle - packet.start_angle) % 36000) / 11) / 100


def test_what_is_no_range_is_sent_as_the_device_would() -> None:
    with LidarEmulator(LD19, np.random.default_rng(3)) as emulator, emulator.path.open("rb", buffering=0) as terminal:
        emulator.due(0.0)
        emulator.due(12.5 / 4500)
        special = np.array([np.nan, np.inf, -np.inf, 0.0, 0.0004, 0.0206, 12.0, 12.001, 1.0, 2.0, 3.0, 4.0])
        emulator.emit(special, np.array([9.0, 9.0, 255.4, 300.0, 1.0, 0.0, 254.6, 77.0, 2.4, -3.0, 120.0, 200.0]))
        (packet,) = slow_parse(terminal.read(4096))
    assert [distance for distance, _ in packet.samples] == [0, 0, 1, 1, 1, 21, 12000, 0, 1000, 2000, 3000, 4000]
    assert [level for _, level in packet.samples] == [0, 0, 255, 255, 1, 1, 255, 0, 2, 1, 120, 200]


def test_nobody_reads_and_nothing_blocks() -> None:
    with LidarEmulator(LD19, np.random.default_rng(4)) as emulator:
        long_ago = time.monotonic() - 40
        for second in range(40):
            emit(emulator, flat(emulator.due(long_ago + second)))
        with pytest.raises(ConfigurationError, match=r"ranges of shape \(3,\) and .*given; \(0,\) were due"):
            emit(emulator, np.ones(3))
        with spinning(emulator, flat), LidarPort(emulator.path, LD19) as port:
            turn = port.wait(time.monotonic(), PATIENCE)
            assert turn.ranges[~np.isnan(turn.ranges)] == pytest.approx(1.5)


def test_a_link_names_the_emulator(tmp_path: Path) -> None:
    link = tmp_path / "lidar"
    for _ in range(2):
        # The second one replaces what a killed one left behind.
        with LidarEmulator(LD19, np.random.default_rng(5), link) as emulator:
            assert emulator.path == link
            assert link.resolve().is_char_device()
        assert not link.is_symlink()
        link.symlink_to("/nonexistent")
    link.unlink()
    link.write_text("precious")
    with pytest.raises(TriformError, match=f"cannot link {link} to a pseudo-terminal: File exists"):
        LidarEmulator(LD19, np.random.default_rng(5), link)
    assert link.read_text() == "precious"


def test_what_a_held_up_reader_missed_does_not_pass_for_news() -> None:
    """The world changes while the reader does not run for so long that it cannot tell how old its bytes are."""
    ranges = 1.0
    emulator = LidarEmulator(LD19, np.random.default_rng(10))

    def look(angles: FloatArray) -> FloatArray:
        return np.full(angles.shape, ranges)

    with emulator, spinning(emulator, look), LidarPort(emulator.path, LD19) as port:
        port.wait(0.0, PATIENCE)
        with port._news:
            time.sleep(1.8)
            ranges = 2.0
            freed = time.monotonic()
        for _ in range(3):
            turn = port.wait(freed, PATIENCE)
            freed = turn.ended
            assert turn.ranges[~np.isnan(turn.ranges)] == pytest.approx(2.0)


def test_reads_gather_packets(monkeypatch: pytest.MonkeyPatch) -> None:
    """One by one they cost a small computer several times as much."""
    fed: list[int] = []
    feed = PacketParser.feed

    def note(parser: PacketParser, data: bytes) -> Packets:
        fed.append(len(data))
        return feed(parser, data)

    monkeypatch.setattr(PacketParser, "feed", note)
    with LidarEmulator(LD19, np.random.default_rng(11)) as emulator, spinning(emulator, flat):
        with LidarPort(emulator.path, LD19) as port:
            port.wait(time.monotonic() + 0.5, PATIENCE)
        assert port.parser.packets > 2 * len(fed)


def test_an_unplugged_lidar_is_one_sentence() -> None:
    emulator = LidarEmulator(LD19, np.random.default_rng(6))
    with LidarPort(emulator.path, LD19) as port:
        with spinning(emulator, flat):
            port.wait(0.0, PATIENCE)
        emulator.close()
        emulator.close()
        assert f"the LiDAR at {emulator.path} is lost" in failure_of(port)


def test_a_silent_lidar_is_one_sentence() -> None:
    with LidarEmulator(LD19, np.random.default_rng(7)) as emulator, LidarPort(emulator.path, LD19) as port:
        assert port.latest() is None
        assert "has sent nothing for 1 s" in failure_of(port)


def test_a_foreign_device_is_one_sentence() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    done = threading.Event()

    def chatter() -> None:
        while not done.wait(0.02):
            os.write(master, b"$GPGGA,123519,4807.038,N,01131.000,E*47\r\n")

    thread = threading.Thread(target=chatter)
    thread.start()
    try:
        with LidarPort(os.ttyname(slave), LD19) as port:
            assert "no LDROBOT LiDAR at 230400 baud" in failure_of(port)
            assert port.parser.skipped > 0
    finally:
        done.set()
        thread.join()
        os.close(master)
        os.close(slave)


def test_a_lidar_that_does_not_turn_finishes_no_turn() -> None:
    with LidarEmulator(LD19, np.random.default_rng(8)) as emulator, LidarPort(emulator.path, LD19) as port:
        began = time.monotonic()
        with pytest.raises(LidarError, match=r"has finished no turn within 0.05 s"):
            port.wait(began, 0.05)


def test_ports_that_cannot_be_opened(tmp_path: Path) -> None:
    missing, file = tmp_path / "none", tmp_path / "file"
    file.write_text("no port")
    with pytest.raises(LidarError, match=f"cannot open the LiDAR's port {missing}: No such file or directory"):
        LidarPort(missing, LD19)
    with pytest.raises(LidarError, match=f"cannot open the LiDAR's port {file}: "):
        LidarPort(file, LD19)
    with LidarEmulator(LD19, np.random.default_rng(9)) as emulator, LidarPort(emulator.path, LD19) as port:
        with pytest.raises(LidarError, match="another program reads it"):
            LidarPort(emulator.path, LD19)
        port.close()
        port.close()
        with pytest.raises(LidarError, match="has been closed"):
            port.latest()
        assert not [thread for thread in threading.enumerate() if thread.name.startswith("LiDAR")]
