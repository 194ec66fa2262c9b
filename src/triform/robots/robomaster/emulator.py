"""An emulated RoboMaster EP: it speaks the plaintext SDK as the robot does, and has no wheels."""

from __future__ import annotations

import math
import select
import socket
import threading
import time
from collections import deque
from typing import Any

import numpy as np

from triform.robots.robomaster import protocol
from triform.robots.robomaster.commands import COMMANDS, MODES, QUERIES, SWITCH, Equipment, ParseError, spaced
from triform.robots.robomaster.watchdog import OK
from triform.types import FloatArray

#: Longest wait before the emulator looks at what others have asked of it [s].
_LOOK = 0.01
#: Rate of a push that is switched on without one [Hz].
_DEFAULT_RATE = 5
#: Speeds of ``chassis move`` without them [m/s, deg/s]; the page names none.
_MOVE_SPEED, _MOVE_TURN = 0.5, 30.0
#: How long telemetry goes on by itself [s].
_TOLD_FOR = 0.2
_FORMAT_ERROR = "command format error: command parse error"
_REFUSED = "fail"
#: Attributes of the chassis that are pushed, and what their rates are called.
_PUSHES = {"position": "pfreq", "attitude": "afreq", "status": "sfreq"}


class RoboMasterEmulator:
    """One robot on an address of this computer, which speaks all of the documented protocol.

    As the real one, it says nothing before ``command;``, stops its wheels when its driver disconnects, and pushes its
    telemetry to the address from which it is driven. Unlike the real one, it hangs up on a second driver, broadcasts
    no address, and nothing ever hits or applauds it. What is no chassis moves at once.

    Attributes:
        address: Where it listens.
        control_port: TCP port of its commands.
        reply_delay: Time that it takes to answer [s].
        end: What ends its answers; nothing in old firmware.
        pieces: Whether its answers come byte by byte.
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
        self.end, self.pieces = ";", False
        self.mode, self.battery = MODES[0], 100
        self._equipment = Equipment()
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
        """The command of the wheels now: a body twist in REP 103, shape (3,) [m/s, m/s, rad/s]."""
        now = time.monotonic()
        return next((twist.copy() for until, twist in self._plan if now < until), np.zeros(3))

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
        self._plan: list[tuple[float, FloatArray]] = []
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
            data = f"{self._answers.popleft()[1]}{self.end}".encode()
            for piece in [bytes([byte]) for byte in data] if self.pieces else [data]:
                self._driver.sendall(piece)
                time.sleep(0.001 * self.pieces)

    def _obey(self, words: list[str]) -> str:
        """Follow a command and return the answer, which is empty for what the robot leaves unanswered."""
        if words == ["command"]:
            answer = "Already in SDK mode" if self.driven else OK
            self.driven = True
            return answer
        if not self.driven:
            return ""
        name, rest = " ".join(words[:2]), words[2:]
        try:
            if name == "chassis push":
                return self._switch(rest)
            if words[-1] == "?":
                return self._tell_of(name, QUERIES[name].read(rest[:-1]))
            if name == "sensor_adapter pulse_period":
                return self._tell_of(name, QUERIES[name].read(rest))
            if name.startswith("robotic_gripper ") and len(rest) == 1:
                # The page's grammar names this argument, and its example does not.
                rest = ["leve", *rest]
            return self._follow(name, COMMANDS[name].read(rest))
        except (KeyError, ParseError):
            return _FORMAT_ERROR
        except ValueError:
            return _REFUSED

    def _follow(self, command: str, given: dict[str, Any]) -> str:
        """Follow a command whose arguments are right."""
        match command:
            case "quit":
                self._leave()
            case "robot mode":
                self.mode = given["0"]
            case "chassis speed":
                self._plan = [(math.inf, protocol.twist_of_speeds(given["x"], given["y"], given["z"]))]
            case "chassis wheel":
                rates = np.array([given[f"w{wheel}"] for wheel in range(1, 5)])
                self._plan = [(math.inf, protocol.twist_of_wheels(rates))]
            case "chassis move":
                self._plan_move(**given)
            case "gimbal push":
                self._set_rate("gimbal", given["attitude"] == "on", int(given.get("afreq", _DEFAULT_RATE)))
            case _:
                self._equipment.obey(command, given)
        return OK

    def _plan_move(
        self, x: float = 0.0, y: float = 0.0, z: float = 0.0, vxy: float = _MOVE_SPEED, vz: float = _MOVE_TURN
    ) -> None:
        """Go to a place as seen from here, then turn; ``z`` is counter-clockwise here, unlike that of speeds."""
        way, turn = math.hypot(x, y), math.radians(z)
        there = time.monotonic() + way / vxy
        ahead = protocol.ROBOT_SIGNS * [x, y, 0.0] / max(way, 1e-9) * vxy
        turning = np.array([0.0, 0.0, math.copysign(math.radians(vz), turn)])
        self._plan = [(there, ahead), (there + abs(z) / vz, turning)]

    def _tell_of(self, query: str, given: dict[str, Any]) -> str:
        """Answer a query whose arguments are right."""
        pose, twist = self._now()
        state = protocol.chassis_state(pose, still=not twist.any())
        match query:
            case "robot mode":
                return self.mode
            case "robot battery":
                return f"{self.battery} "
            case "chassis speed":
                speeds, rates = protocol.speeds_of_twist(twist)
                return f"{spaced(speeds)} {' '.join(map(str, rates))}"
            case "chassis position":
                return " ".join([*state["position"], state["attitude"][2]])
            case "chassis attitude" | "chassis status":
                return " ".join(state[query.split()[1]])
        return self._equipment.answer(query, given)

    def _switch(self, words: list[str]) -> str:
        """Switch pushes on or off, such as ``position on pfreq 20 attitude off`` or ``freq 10`` for all that are on."""
        words = list(words)
        for attribute in _PUSHES:
            # The page also has ``position pfreq 1 freq 5``.
            if attribute in words[:-1] and words[words.index(attribute) + 1].endswith("freq"):
                words.insert(words.index(attribute) + 1, "on")
        settings = dict(zip(words[::2], words[1::2], strict=False))
        rates = {name: settings.get(name) for name in (*_PUSHES.values(), "freq")}
        switches = {name: settings.get(name) for name in _PUSHES}
        if (
            len(words) != 2 * len(settings)
            or not settings
            or not settings.keys() <= rates.keys() | switches.keys()
            or not {*rates.values()} <= {None, *map(str, protocol.PUSH_RATES)}
            or not {*switches.values()} <= {None, *SWITCH}
        ):
            return _REFUSED
        for name, switch in switches.items():
            rate = rates["freq"] or rates[_PUSHES[name]]
            if switch is not None or (rate and name in self._rates):
                self._set_rate(name, switch != "off", int(rate or self._rates.get(name, _DEFAULT_RATE)))
        return OK

    def _set_rate(self, name: str, on: bool, rate: int) -> None:
        self._rates.pop(name, None)
        self._due.pop(name, None)
        if on:
            self._rates[name], self._due[name] = rate, time.monotonic()

    def _now(self) -> tuple[FloatArray, FloatArray]:
        """Pose and twist of what was told last; the motion goes on for a moment."""
        told, pose, twist = self._told
        u_x, u_y, omega = twist
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        way = np.array([cos * u_x - sin * u_y, sin * u_x + cos * u_y, omega])
        return pose + min(time.monotonic() - told, _TOLD_FOR) * way, twist

    def _push(self) -> None:
        now = time.monotonic()
        due = [name for name, moment in self._due.items() if moment <= now]
        if self._driver is None or not due:
            return
        for name in due:
            self._due[name] = max(now, self._due[name] + 1 / self._rates[name])
        pose, twist = self._now()
        state = protocol.chassis_state(pose, still=not twist.any())
        parts = [" ".join([name, *state[name]]) for name in _PUSHES if name in due]
        pushes = [f"chassis push {' ; '.join(parts)} ;"] * bool(parts)
        if "gimbal" in due:
            pushes.append(f"gimbal push attitude {spaced(self._equipment.gimbal)} ;")
        for text in pushes:
            self._pushes.sendto(text.encode(), (self._driver.getpeername()[0], protocol.PUSH_PORT))
