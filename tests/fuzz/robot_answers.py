"""Campaign: whatever a RoboMaster answers and pushes, its wheels get finite commands and stop.

    python -m tests.fuzz.robot_answers --seconds 60 --seed 0

One try in a hundred drives an emulated robot, in a real process, whose answers and pushes are damaged, cut into pieces
and delayed. The others put damaged answers and pushes through what reads them, and what is believed through a
controller of one robot, to its wheels.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
import warnings

import numpy as np

from tests.fuzz.trials import options
from triform.control import ControllerSpec
from triform.robots.drive import DriveConfig
from triform.robots.laser_scan import Turn
from triform.robots.odometry import Track
from triform.robots.real import RealRobot
from triform.robots.robomaster import RoboMaster, RoboMasterEmulator, RoboMasterError
from triform.robots.robomaster.protocol import chassis_state, read_pushed, speed_command
from triform.robots.robomaster.watchdog import Answers
from triform.types import FloatArray, ScanConfig, TriformError

LIVE_EVERY = 100
WATCHDOG = 0.3
#: A machine that does other things too wakes a process late [s].
SLACK = 0.5
_WORDS = (
    b"ok ; ;; fail nan inf -inf 1e308 -1e308 1e999 1000 -1000 0x10 1_0 \x1b[2J \x1b]0;x\x07 \x9b31m \xff\xfe \0 \r\n"
    b" chassis push position attitude status gimbal Already 99999999999999999999"
).split(b" ")


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a message in no to three places."""
    content = bytearray(data)
    for _ in range(rng.integers(0, 4)):
        place = int(rng.integers(len(content) + 1))
        kind = rng.integers(5)
        if kind == 0 and place < len(content):
            content[place] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            content[place : place + int(rng.integers(1, 8))] = b""
        elif kind == 2:
            content[place:place] = _WORDS[rng.integers(len(_WORDS))]
        elif kind == 3:
            content[place:place] = content[: int(rng.integers(1, 40))]
        elif kind == 4:
            words = bytes(content).split(b" ")
            words[rng.integers(len(words))] = _WORDS[rng.integers(len(_WORDS))]
            content = bytearray(b" ".join(words))
    return bytes(content)


class Lidar:
    """Sees other robots around, always anew."""

    scan = ScanConfig(rays=120)

    def __init__(self, rng: np.random.Generator) -> None:
        self._ranges = np.where(rng.random(120) < 0.2, 0.8, np.inf).astype(np.float32)

    def latest(self) -> Turn:
        """Return a turn that has just ended."""
        now = time.monotonic()
        return Turn(self._ranges, now - 0.2, now - 0.03)


class Base:
    """Wheels whose odometry is what damaged pushes leave, and which take the text of commands."""

    def __init__(self) -> None:
        self.tracks = {"position": Track([0.15] * 2), "attitude": Track([1.0], angle=True)}
        self.commands: list[str] = []

    def drive(self, command: FloatArray) -> None:
        """Take a command."""
        assert np.isfinite(command).all(), f"the wheels get {command}"
        self.commands.append(speed_command(command))

    def stop(self) -> None:
        """Stop."""

    def odometry(self, at: float) -> FloatArray | None:
        """Return the pose that is believed."""
        parts = [track.at(at) for track in self.tracks.values()]
        return None if any(part is None for part in parts) else np.concatenate(parts)


CONTROLLER = DriveConfig(controller=ControllerSpec("scan-triangulating")).make_controller(lambda: None)


def dry(rng: np.random.Generator) -> None:
    """Read damaged answers and pushes, and command one step by what is believed."""
    answers = Answers(bool(rng.integers(2)))
    stream = damage(b"ok;" * int(rng.integers(1, 5)) + b"fail;100 ;", rng)
    cuts = np.sort(rng.integers(0, len(stream) + 1, 5))
    for piece in np.split(np.frombuffer(stream, np.uint8), cuts):
        for answer in answers.feed(piece.tobytes()):
            assert RoboMasterError(f'it says "{answer}"').args[0].isprintable()
            assert "\n" not in answer
    base = Base()
    now = time.monotonic()
    place = rng.uniform(-1, 1, 3)
    for moment in np.arange(now - 1.0, now, 0.05):
        place = place + rng.normal(0, 0.003, 3)
        state = chassis_state(place, still=False)
        parts = [" ".join([name, *state[name]]) for name in ("position", "attitude")]
        data = damage(f"chassis push {' ; '.join(parts)} ;".encode(), rng)
        for name, values in read_pushed(data.decode("ascii", "replace")):
            assert np.isfinite(values).all()
            base.tracks[name].add(float(moment), values)
    robot = RealRobot(Lidar(rng), base, 0.001, 0, DriveConfig().limits)
    view = robot.observe()
    if view.odometry is not None:
        assert np.abs(view.odometry[..., :2]).max() < 1.0, f"odometry {view.odometry} is believed"
    robot.apply(CONTROLLER.command(view), 0.001)
    assert len(base.commands) == 1
    assert "nan" not in base.commands[0]
    assert "inf" not in base.commands[0]


class DamagedRobot(RoboMasterEmulator):
    """Damages, cuts and delays what it answers and pushes, once ``damaging`` is set."""

    def __init__(self, address: str, rng: np.random.Generator) -> None:
        self.damaging = False
        self._rng = rng
        super().__init__(address, control_port=0)
        self._socket = self._pushes
        self._pushes = self  # type: ignore[assignment]

    def sendto(self, data: bytes, where: tuple[str, int]) -> None:
        """Push a damaged datagram."""
        self._socket.sendto(damage(data, self._rng) if self.damaging else data, where)

    def __enter__(self) -> DamagedRobot:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave."""
        if threading.current_thread() is not self._thread:
            super().close()
            self._socket.close()

    def _answer(self) -> None:
        while self._driver is not None and self._answers and self._answers[0][0] <= time.monotonic():
            data = f"{self._answers.popleft()[1]}{self.end}".encode()
            if self.damaging and self._rng.random() < 0.2:
                data = damage(data, self._rng)
            for cut in range(0, len(data), 2):
                self._driver.sendall(data[cut : cut + 2])
                time.sleep(0.001 * self.damaging * self._rng.integers(2))


def drive_it(emulator: DamagedRobot, rng: np.random.Generator) -> None:
    """Connect to a robot, drive it for half a second and leave it."""
    address = emulator.address
    with RoboMaster(address, address, WATCHDOG, control_port=emulator.control_port) as base:
        assert base.battery is None or 0 <= base.battery <= 999
        emulator.damaging = True
        for _ in range(10):
            base.drive(rng.uniform(-1, 1, 3))
            assert np.isfinite(emulator.command).all()
            assert np.abs(emulator.command).max() <= math.pi + 0.01
            time.sleep(0.05)
            pose = base.odometry(time.monotonic())
            assert pose is None or np.isfinite(pose).all()


def live(rng: np.random.Generator, address: str) -> None:
    """Drive a damaged robot until it is lost, or for half a second, and wait until its wheels stand."""
    with DamagedRobot(address, rng) as emulator:
        emulator.damaging = rng.random() < 0.3
        emulator.end = ";" if rng.random() < 0.9 else ""
        sentence = ""
        try:
            drive_it(emulator, rng)
        except RoboMasterError as error:
            sentence = str(error)
        assert sentence.isprintable(), sentence
        deadline = time.monotonic() + WATCHDOG + SLACK
        while emulator.command.any():
            assert time.monotonic() < deadline, "the wheels still turn"
            time.sleep(0.002)


def main() -> int:
    """Run the campaign and return the exit status."""
    given = options(__doc__ or "", sys.maxsize, 60.0)
    warnings.simplefilter("error")
    address = f"127.75.{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"
    broken: list[str] = []
    threading.excepthook = lambda args: broken.append(f"{args.exc_type.__name__} in a thread: {args.exc_value}")
    tried = lived = failed = 0
    end = time.monotonic() + given.seconds
    while tried < given.tries and time.monotonic() < end:
        rng = np.random.default_rng([given.seed, tried])
        try:
            if tried % LIVE_EVERY == 0:
                live(rng, address)
                lived += 1
            else:
                dry(rng)
        except (Exception, TriformError) as error:  # noqa: BLE001
            broken.append(f"{type(error).__name__}: {error}")
        if broken:
            failed += 1
            print(f"seed [{given.seed}, {tried}]: {'; '.join(broken)}")
            broken.clear()
        tried += 1
    print(f"robot_answers: {tried} tried, {failed} failed; {lived} of them drove")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
