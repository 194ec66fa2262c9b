"""An emulated RoboMaster EP: it speaks the plaintext SDK as the robot does, and has no wheels."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections import deque

import numpy as np

from triform.robots.robomaster import protocol
from triform.robots.robomaster.watchdog import OK
from triform.types import FloatArray

#: Longest wait before the emulator looks at what others have asked of it [s].
_LOOK = 0.01
#: Rate of a push that is switched on without one [Hz].
_DEFAULT_RATE = 5
#: How long telemetry goes on by itself [s].
_TOLD_FOR = 0.2
_FORMAT_ERROR = "command format error: command parse error"
_MODES = ("chassis_lead", "gimbal_lead", "free")


class RoboMasterEmulator:
    """One robot on an address of this computer.

    As the real one, it says nothing before ``command;``, stops its wheels when its driver disconnects, and pushes its
    telemetry to the address from which it is driven. Unlike the real one, it hangs up on a second driver.

    Attributes:
        address: Where it listens.
        control_port: TCP port of its commands.
        reply_delay: Time that it takes to answer [s].
        silent: Whether it answers no command, though it obeys.
        error: What it answers to everything, without obeying; nothing special if empty.
        mode: How chassis and gimbal hang together.
        battery: Charge in percent.
        driven: Whether a driver is connected and in SDK mode.
    """

    def __init__(self, address: str = "127.0.0.1", *, control_port: int = protocol.CONTROL_PORT) -> None:
        """Start a robot.

        Args:
            address: Address of this computer, such as 127.0.1.1.
            control_port: TCP port to listen at; 0 chooses a free one.

        Raises:
            RoboMasterError: The address or port cannot be used.
        """
        try:
            self._listener = socket.create_server((address, control_port))
        except OSError as error:
            raise protocol.RoboMasterError(
                f"cannot emulate a RoboMaster at {address}:{control_port}: {error.strerror}"
            ) from error
        self._pushes = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._pushes.bind((address, 0))
        self.address, self.control_port = self._listener.getsockname()
        self.reply_delay, self.silent, self.error = 0.0, False, ""
        self.mode, self.battery = _MODES[0], 100
        self._told = (time.monotonic(), np.zeros(3), np.zeros(3))
        self._driver: socket.socket | None = None
        self._text = b""
        self._answers: deque[tuple[float, str]] = deque()
        self._leave()
        self._closing, self._hang_up = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="robomaster-emulator", daemon=True)
        self._thread.start()

    def __enter__(self) -> RoboMasterEmulator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def command(self) -> FloatArray:
        """What the wheels are told now: a body twist in REP 103, shape (3,) [m/s, m/s, rad/s]."""
        return self._command.copy()

    def tell(self, pose: FloatArray, twist: FloatArray) -> None:
        """Say where the robot is and how it moves now; its telemetry goes on from there.

        Args:
            pose: Pose in REP 103, shape (3,) [m, m, rad].
            twist: Body twist in REP 103, shape (3,) [m/s, m/s, rad/s].
        """
        self._told = (time.monotonic(), np.array(pose, dtype=np.float64), np.array(twist, dtype=np.float64))

    def hang_up(self) -> None:
        """Close the connection to the driver."""
        self._hang_up.set()

    def close(self) -> None:
        """Close the connection and listen no more."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        with self._listener, self._pushes:
            while not self._closing.is_set():
                self._work()
            self._disconnect()

    def _work(self) -> None:
        """Do what is due, then wait for a moment or for a driver."""
        if self._hang_up.is_set():
            self._hang_up.clear()
            self._disconnect()
        sockets = [self._listener] if self._driver is None else [self._listener, self._driver]
        try:
            for ready in select.select(sockets, [], [], _LOOK)[0]:
                if ready is self._listener:
                    self._accept()
                else:
                    self._hear(ready.recv(4096))
            self._answer()
            self._push()
        except OSError:
            self._disconnect()

    def _accept(self) -> None:
        driver, _ = self._listener.accept()
        if self._driver is None:
            self._driver = driver
        else:
            driver.close()

    def _disconnect(self) -> None:
        if self._driver is not None:
            self._driver.close()
        self._driver, self._text = None, b""
        self._answers.clear()
        self._leave()

    def _leave(self) -> None:
        """Leave SDK mode: the wheels stop, and no telemetry is pushed."""
        self.driven = False
        self._command = np.zeros(3)
        self._rates: dict[str, int] = {}
        self._due: dict[str, float] = {}

    def _hear(self, data: bytes) -> None:
        if not data:
            self._disconnect()
            return
        *commands, self._text = (self._text + data).split(b";")
        for command in commands:
            answer = self.error or self._obey(command.decode("ascii", "replace").split(" "))
            if answer and not self.silent:
                self._answers.append((time.monotonic() + self.reply_delay, answer))

    def _answer(self) -> None:
        while self._driver is not None and self._answers and self._answers[0][0] <= time.monotonic():
            self._driver.sendall(f"{self._answers.popleft()[1]};".encode())

    def _obey(self, words: list[str]) -> str:
        """Follow a command and return the answer, which is empty for what the robot leaves unanswered."""
        if words == ["command"]:
            answer = "Already in SDK mode" if self.driven else OK
            self.driven = True
            return answer
        if not self.driven:
            return ""
        match words:
            case ["quit"]:
                self._leave()
                return OK
            case ["robot", "battery", "?"]:
                return f"{self.battery} "
            case ["robot", "mode", mode] if mode in _MODES:
                self.mode = mode
                return OK
            case ["chassis", "speed", "x", x, "y", y, "z", z]:
                limits = np.array([protocol.MAX_SPEED, protocol.MAX_SPEED, np.degrees(protocol.MAX_TURN_RATE)])
                return self._move([x, y, z], limits)
            case ["chassis", "wheel", "w1", w1, "w2", w2, "w3", w3, "w4", w4]:
                return self._move([w1, w2, w3, w4], np.full(4, protocol.MAX_WHEEL_RATE))
            case ["chassis", "push", *settings]:
                return self._switch(settings)
        return _FORMAT_ERROR

    def _move(self, words: list[str], limits: FloatArray) -> str:
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            return "fail"
        if not (np.abs(values) <= limits + 1e-9).all():
            return "fail"
        self._command = protocol.twist_of_speeds(*values) if len(values) == 3 else protocol.twist_of_wheels(values)
        return OK

    def _switch(self, words: list[str]) -> str:
        """Switch pushes on or off, such as ``position on pfreq 20 attitude off``."""
        settings = dict(zip(words[::2], words[1::2], strict=False))
        allowed = {"position", "pfreq", "attitude", "afreq"}
        if len(words) != 2 * len(settings) or not settings or not settings.keys() <= allowed:
            return "fail"
        rates = self._rates.copy()
        for name in ("position", "attitude"):
            switch, rate = settings.get(name), settings.get(f"{name[0]}freq", str(_DEFAULT_RATE))
            if switch not in (None, "on", "off") or rate not in map(str, protocol.PUSH_RATES):
                return "fail"
            if switch == "on":
                rates[name] = int(rate)
            elif switch == "off":
                rates.pop(name, None)
        self._rates, self._due = rates, dict.fromkeys(rates, time.monotonic())
        return OK

    def _push(self) -> None:
        now = time.monotonic()
        due = [name for name, moment in self._due.items() if moment <= now]
        if self._driver is None or not due:
            return
        for name in due:
            self._due[name] = max(now, self._due[name] + 1 / self._rates[name])
        told, pose, (u_x, u_y, omega) = self._told
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        pose = pose + min(now - told, _TOLD_FOR) * np.array([cos * u_x - sin * u_y, sin * u_x + cos * u_y, omega])
        text = protocol.pushed(pose, due)
        self._pushes.sendto(text.encode(), (self._driver.getpeername()[0], protocol.PUSH_PORT))
