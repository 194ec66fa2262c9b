"""Driver of a RoboMaster EP over Wi-Fi or USB, with its plaintext SDK."""

from __future__ import annotations

import math
import os
import re
import select
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import ExitStack, suppress

import numpy as np

from triform.robots.robomaster import protocol, watchdog
from triform.robots.robomaster.protocol import RoboMasterError
from triform.robots.robomaster.telemetry import Telemetry
from triform.robots.robomaster.watchdog import Answers
from triform.types import FloatArray, require

#: Address of a robot that the computer has joined over the robot's own Wi-Fi.
WIFI_ADDRESS = "192.168.2.1"
#: Address of a robot at the computer's USB port.
USB_ADDRESS = "192.168.42.2"

#: Rate of telemetry [Hz].
_PUSH_RATE = 20
#: Longest wait for the connection and each answer of the robot, and for the watchdog to start [s].
_PATIENCE = 5.0
#: While connecting, an answer of old firmware is whole when nothing has come for so long [s].
_PAUSE = 1.0
#: Share of the watchdog's time within which the robot has to confirm that the wheels have a newer command.
_CONFIRMED_WITHIN = 0.9
#: The least share of the watchdog's time that an answer may take, however late its command was.
_ANSWERED_WITHIN = 1 / 6
_KEEPER_ENDED = "the process that keeps its wheels has ended"


class RoboMaster:
    """The wheels of one RoboMaster EP, and its odometry.

    Commands go through a small process of its own, the watchdog, which stops the wheels when no fresh one comes, and
    when this process closes the robot or ends in any way. ``drive`` never waits: a thread reads what the robot answers.
    A robot that answers with an error, late or not at all is given up, and so is a watchdog that hangs or ends: the
    thread stops the wheels itself, closes the connection, and every later command raises the same error.

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
            watchdog: How long a command holds that no newer one follows, and, to 0.9 of it, within which the robot has
                to confirm a newer one [s].
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
        self._confirmed = -math.inf
        self._failure = ""
        self._lock = threading.Lock()
        source = None if local_address is None else (local_address, 0)
        try:
            self._robot = socket.create_connection((address, control_port), _PATIENCE, source)
        except OSError as error:
            raise RoboMasterError(f"cannot reach {self._name}: {error.strerror or error}") from error
        with ExitStack() as opened:
            opened.enter_context(self._robot)
            self._robot.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            here, robot = self._robot.getsockname()[0], self._robot.getpeername()[0]
            self._telemetry = Telemetry(here, push_port, robot, math.sqrt(2) * max_speed, max_turn_rate)
            opened.callback(self._telemetry.close)
            answers = Answers()
            self.battery = self._enter(answers)
            self._process, self._channel = self._start_watchdog(answers.ended)
            opened.pop_all()
        self._listener = threading.Thread(target=self._listen, name="robomaster-answers", daemon=True)
        self._listener.start()

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
        with self._lock:
            if not self._failure:
                self._failure = f"{self._name} is closed"
                with suppress(OSError):
                    self._channel.shutdown(socket.SHUT_WR)
        try:
            self._process.wait(_CONFIRMED_WITHIN * self._watchdog)
        except subprocess.TimeoutExpired:
            self._cut()
            self._process.wait()
        self._listener.join()
        self._channel.close()
        self._robot.close()
        self._telemetry.close()

    def _enter(self, answers: Answers) -> int | None:
        """Enter SDK mode and return the charge of the battery in percent, ``None`` if the robot does not know it."""
        entered = self._ask("command;", answers)
        # So says a robot that has not noticed yet that the last driver has left.
        if entered not in (watchdog.OK, "Already in SDK mode"):
            raise RoboMasterError(f'{self._name} does not enter SDK mode: it answers "{entered}"')
        battery = self._ask("robot battery ?;", answers)
        for command in (
            "robot mode free;",
            f"chassis push position on pfreq {_PUSH_RATE} attitude on afreq {_PUSH_RATE};",
            watchdog.STOP,
        ):
            answer = self._ask(command, answers)
            if answer != watchdog.OK:
                raise RoboMasterError(f'{self._name} refuses "{command}": it answers "{answer}"')
        return int(battery) if re.fullmatch("[0-9]{1,3}", battery) else None

    def _ask(self, command: str, answers: Answers) -> str:
        """Send a command and wait for its answer, which may come in pieces."""
        found: list[str] = []
        deadline = time.monotonic() + _PATIENCE
        try:
            self._robot.sendall(command.encode())
            while not found:
                left = deadline - time.monotonic()
                self._robot.settimeout(max(0.01, min(left, _PAUSE) if answers.open else left))
                try:
                    data = self._robot.recv(4096)
                except TimeoutError:
                    if not answers.open or left <= 0:
                        raise
                    found = answers.pause()
                    continue
                if not data:
                    raise RoboMasterError(
                        f'{self._name} closed the connection at "{command}"; does another program drive it?'
                    )
                found = answers.feed(data)
        except OSError as error:
            raise RoboMasterError(f'{self._name} does not answer "{command}": {error.strerror or error}') from error
        return found[0]

    def _start_watchdog(self, ended: bool) -> tuple[subprocess.Popen[bytes], socket.socket]:
        """Start the watchdog and share the connection with it."""
        ours, theirs = socket.socketpair()
        ends = self._robot.fileno(), theirs.fileno()
        # -I and -S: nothing but the standard library. A session of its own: Ctrl-C and a closed terminal end the
        # driving process alone, and the watchdog notices that.
        settings = (*ends, self._watchdog, os.getpid(), int(ended))
        arguments = [sys.executable, "-I", "-S", watchdog.__file__, *map(str, settings)]
        lost = f"the process that keeps the wheels of {self._name} did not start"
        try:
            with theirs:
                process = subprocess.Popen(arguments, pass_fds=ends, stdin=subprocess.DEVNULL, start_new_session=True)
        except OSError as error:
            ours.close()
            raise RoboMasterError(f"{lost}: {error.strerror}") from error
        ours.settimeout(_PATIENCE)
        ready = f"{watchdog.READY}\n".encode()
        with suppress(OSError), ours.makefile("rb") as said:
            if said.read(len(ready)) == ready:
                return process, ours
        ours.close()
        process.kill()
        process.wait()
        raise RoboMasterError(lost)

    def _send(self, command: str) -> None:
        with self._lock:
            if not self._failure:
                now = time.monotonic()
                line = f"{now!r} {command}\n".encode()
                try:
                    # A full channel, too, is one that the watchdog does not read.
                    taken = self._channel.send(line, socket.MSG_DONTWAIT) == len(line)
                except OSError:
                    taken = False
                if taken:
                    self._waiting.append(now)
                    return
                self._fail(_KEEPER_ENDED)
            raise RoboMasterError(self._failure)

    def _listen(self) -> None:
        """Read answers until the robot is closed or lost."""
        rest = b""
        while not self._failure:
            # A command that is sent while nothing waits can be late only after this.
            due = self._due() if self._waiting else time.monotonic() + _ANSWERED_WITHIN * self._watchdog
            ready = select.select([self._channel], [], [], max(0.0, due - time.monotonic()))[0]
            data = b""
            with suppress(ConnectionResetError):
                data = self._channel.recv(4096) if ready else b""
            now = time.monotonic()
            with self._lock:
                *lines, rest = (rest + data).split(b"\n")
                for line in lines:
                    self._take(line.decode())
                if ready and not data:
                    self._fail(_KEEPER_ENDED)
                if not ready and self._waiting and now > self._due():
                    self._fail(f"it has not answered for {now - self._waiting[0]:.2f} s")

    def _due(self) -> float:
        """Moment by which the oldest command that waits has to be confirmed [s]."""
        oldest = self._waiting[0]
        # After a pause the wheels stand, and only the new command makes them turn.
        since = self._confirmed if oldest < self._confirmed + self._watchdog else oldest
        return max(since + _CONFIRMED_WITHIN * self._watchdog, oldest + _ANSWERED_WITHIN * self._watchdog)

    def _take(self, line: str) -> None:
        """Take an answer; those to commands that the watchdog gave by itself have no moment of a command."""
        sent, answered, answer = line.split(" ", 2)
        moment = float(sent)
        if answer != watchdog.OK:
            self._fail(f'it says "{answer}"')
        elif self._waiting and moment < math.inf:
            if float(answered) > self._due():
                self._fail(f"it answered after {float(answered) - moment:.2f} s")
            self._confirmed = moment
            while self._waiting and self._waiting[0] <= moment:
                self._waiting.popleft()

    def _fail(self, reason: str) -> None:
        """Give the robot up, unless that is done, and stop its wheels."""
        if not self._failure:
            self._failure = f"{self._name} is lost: {reason}"
            self._cut()

    def _cut(self) -> None:
        """Stop the wheels without the watchdog, in whatever state it is, and end the connection."""
        with suppress(OSError):
            self._robot.send(f"{watchdog.STOP}{watchdog.QUIT}".encode(), socket.MSG_DONTWAIT)
        with suppress(OSError):
            self._robot.shutdown(socket.SHUT_WR)
        self._process.kill()
