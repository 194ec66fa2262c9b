"""Driver of a RoboMaster EP over Wi-Fi or USB, with its plaintext SDK."""

from __future__ import annotations

import math
import os
import socket
import subprocess
import sys
import time
from collections import deque
from contextlib import suppress

import numpy as np

from triform.robots.robomaster import protocol, watchdog
from triform.robots.robomaster.protocol import RoboMasterError
from triform.robots.robomaster.telemetry import Telemetry
from triform.types import FloatArray, require

#: Address of a robot that the computer has joined over the robot's own Wi-Fi.
WIFI_ADDRESS = "192.168.2.1"
#: Address of a robot at the computer's USB port.
USB_ADDRESS = "192.168.42.2"

#: Rate of telemetry [Hz].
_PUSH_RATE = 20
#: Longest wait for the connection and each answer of the robot, and for the watchdog to start or end [s].
_PATIENCE = 5.0
_KEEPER_ENDED = "the process that keeps its wheels has ended"


class RoboMaster:
    """The wheels of one RoboMaster EP, and its odometry.

    Commands go through a small process of its own, the watchdog, which stops the wheels when no fresh one comes, and
    when this process closes the robot or ends in any way. ``drive`` never waits: what the robot answers is looked at in
    the next call. A robot that answers with an error, late or not at all is given up: the watchdog stops its wheels, if
    they can still be reached, and every later command raises the same error.

    Attributes:
        battery: Charge when it was connected, in percent; ``None`` if the robot does not tell.
    """

    def __init__(
        self,
        address: str = WIFI_ADDRESS,
        local_address: str | None = None,
        watchdog: float = 0.3,
        *,
        max_speed: float = 0.5,
        max_turn_rate: float = math.pi,
        control_port: int = protocol.CONTROL_PORT,
        push_port: int = protocol.PUSH_PORT,
    ) -> None:
        """Connect to a robot, enter SDK mode, free the chassis of the gimbal and switch telemetry on.

        Args:
            address: The robot's address.
            local_address: Address of this computer to connect from; chosen by the system if ``None``.
            watchdog: How long a command holds, and how late its answer may be [s].
            max_speed: Faster commands are clipped along x and y [m/s].
            max_turn_rate: Faster turns are clipped [rad/s].
            control_port: TCP port of the robot's commands.
            push_port: UDP port of this computer for the robot's telemetry.

        Raises:
            ConfigurationError: A limit is not positive, or more than the robot takes.
            RoboMasterError: The robot cannot be reached or refuses.
        """
        require(0 < watchdog < math.inf, f"watchdog is {watchdog} s; it must be positive and finite")
        for name, value, most in (
            ("max_speed", max_speed, protocol.MAX_SPEED),
            ("max_turn_rate", max_turn_rate, protocol.MAX_TURN_RATE),
        ):
            require(0 < value <= most, f"{name} is {value}; it must be positive and at most {most:.4g}")
        self._name = f"the RoboMaster at {address}:{control_port}"
        self._limits = np.array([max_speed, max_speed, max_turn_rate])
        self._watchdog = watchdog
        self._waiting: deque[float] = deque()
        self._rest = b""
        self._failure = ""
        source = None if local_address is None else (local_address, 0)
        try:
            robot = socket.create_connection((address, control_port), _PATIENCE, source)
        except OSError as error:
            raise RoboMasterError(f"cannot reach {self._name}: {error.strerror or error}") from error
        with robot:
            robot.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._telemetry = Telemetry(robot.getsockname()[0], push_port, robot.getpeername()[0])
            try:
                self.battery = self._enter(robot)
                self._process, self._channel = self._start_watchdog(robot)
            except BaseException:
                self._telemetry.close()
                raise

    def __enter__(self) -> RoboMaster:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def drive(self, command: FloatArray) -> None:
        """Hold a body twist until the next one, for the time of the watchdog at most.

        Args:
            command: Body twist in REP 103, shape (3,) [m/s, m/s, rad/s]; what is faster than the limits is clipped.

        Raises:
            RoboMasterError: The robot is lost or has refused a command, or ``command`` is no three finite numbers; the
                wheels are then stopped.
        """
        values = np.asarray(command, dtype=np.float64)
        if values.shape != (3,) or not np.isfinite(values).all():
            self.stop()
            raise RoboMasterError(f"the command {command} cannot be driven; three finite numbers are needed")
        self._send(protocol.speed_command(np.clip(values, -self._limits, self._limits)))

    def stop(self) -> None:
        """Stop the wheels.

        Raises:
            RoboMasterError: The robot is lost or has refused a command.
        """
        self._send(watchdog.STOP)

    def odometry(self, at: float) -> FloatArray | None:
        """Pose at a moment, in the frame in which the robot was switched on.

        Args:
            at: Moment of the monotonic clock [s]; at most 0.2 s after the newest push.

        Returns:
            Pose in REP 103, shape (3,) [m, m, rad], by when its pushes arrived here; ``None`` if it is not known.
        """
        return self._telemetry.pose(at)

    def close(self) -> None:
        """Stop the wheels, leave SDK mode and disconnect; harmless when done before."""
        self._failure = self._failure or f"{self._name} is closed"
        self._channel.close()
        try:
            self._process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            # Its end closes the connection, and a robot that has lost its connection stops by itself.
            self._process.kill()
            self._process.wait()
        self._telemetry.close()

    def _enter(self, robot: socket.socket) -> int | None:
        """Enter SDK mode and return the charge of the battery in percent, ``None`` if the robot does not know it."""
        entered = self._ask(robot, "command;")
        # So says a robot that has not noticed yet that the last driver has left.
        if entered not in (watchdog.OK, "Already in SDK mode"):
            raise RoboMasterError(f'{self._name} does not enter SDK mode: it answers "{entered}"')
        battery = self._ask(robot, "robot battery ?;")
        for command in (
            "robot mode free;",
            f"chassis push position on pfreq {_PUSH_RATE} attitude on afreq {_PUSH_RATE};",
            watchdog.STOP,
        ):
            answer = self._ask(robot, command)
            if answer != watchdog.OK:
                raise RoboMasterError(f'{self._name} refuses "{command}": it answers "{answer}"')
        return int(battery) if battery.isdigit() else None

    def _ask(self, robot: socket.socket, command: str) -> str:
        try:
            robot.sendall(command.encode())
            data = robot.recv(4096)
        except OSError as error:
            raise RoboMasterError(f'{self._name} does not answer "{command}": {error.strerror or error}') from error
        if not data:
            raise RoboMasterError(f'{self._name} closed the connection at "{command}"; does another program drive it?')
        return " ".join(watchdog.answers(data))

    def _start_watchdog(self, robot: socket.socket) -> tuple[subprocess.Popen[bytes], socket.socket]:
        """Start the watchdog and hand it the connection."""
        ours, theirs = socket.socketpair()
        ends = robot.fileno(), theirs.fileno()
        # -I and -S: nothing but the standard library. A session of its own: Ctrl-C and a closed terminal end the
        # driving process alone, and the watchdog notices that.
        arguments = [sys.executable, "-I", "-S", watchdog.__file__, *map(str, (*ends, self._watchdog, os.getpid()))]
        lost = f"the process that keeps the wheels of {self._name} did not start"
        try:
            with theirs:
                process = subprocess.Popen(arguments, pass_fds=ends, stdin=subprocess.DEVNULL, start_new_session=True)
        except OSError as error:
            ours.close()
            raise RoboMasterError(f"{lost}: {error.strerror}") from error
        ours.settimeout(_PATIENCE)
        with suppress(OSError):
            if ours.recv(4096) == f"{watchdog.READY}\n".encode():
                ours.setblocking(False)
                return process, ours
        ours.close()
        process.kill()
        process.wait()
        raise RoboMasterError(lost)

    def _send(self, command: str) -> None:
        self._check()
        now = time.monotonic()
        try:
            self._channel.sendall(f"{now!r} {command}\n".encode())
        except OSError:
            self._fail(_KEEPER_ENDED)
        self._waiting.append(now)

    def _check(self) -> None:
        """Look at what has been answered, without waiting."""
        if self._failure:
            raise RoboMasterError(self._failure)
        now = time.monotonic()
        try:
            while data := self._channel.recv(4096):
                *lines, self._rest = (self._rest + data).split(b"\n")
                for line in lines:
                    self._take(line.decode())
            self._fail(_KEEPER_ENDED)
        except BlockingIOError:
            pass
        except OSError:
            self._fail(_KEEPER_ENDED)
        if self._waiting and now - self._waiting[0] > self._watchdog:
            self._fail(f"it has not answered for {now - self._waiting[0]:.2f} s")

    def _take(self, line: str) -> None:
        sent, answered, answer = line.split(" ", 2)
        if answer != watchdog.OK:
            self._fail(f'it says "{answer}"')
        if float(answered) - float(sent) > self._watchdog:
            self._fail(f"it answered after {float(answered) - float(sent):.2f} s")
        while self._waiting and self._waiting[0] <= float(sent):
            self._waiting.popleft()

    def _fail(self, reason: str) -> None:
        """Give the robot up: the watchdog stops its wheels and leaves."""
        self._failure = f"{self._name} is lost: {reason}"
        self._channel.close()
        raise RoboMasterError(self._failure)
