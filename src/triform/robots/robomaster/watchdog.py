"""Watchdog of a RoboMaster's wheels: a small process that stops them when nobody drives any more.

It owns the connection to the robot and gets commands from the driving process through a socket. When no fresh command
has come for the time of the watchdog, it stops the wheels. When the driving process closes the socket or ends in
whatever way (the system then closes it, even after SIGKILL), or on SIGTERM, it stops the wheels, leaves SDK mode and
ends.

This file runs as a script and needs the standard library alone, so that it starts at once and has little to fail with.
"""

from __future__ import annotations

import math
import os
import select
import signal
import socket
import sys
import time
from collections import deque
from contextlib import suppress

#: Stops the wheels. ``chassis speed`` with zeros holds the heading instead, and with it the robot creeps round.
STOP = "chassis wheel w1 0 w2 0 w3 0 w4 0;"
QUIT = "quit;"
#: What the robot answers to a command that it has taken.
OK = "ok"
#: What the watchdog tells the driving process when it is ready.
READY = "ready"

#: Longest wait for an answer while leaving [s].
_PATIENCE = 0.5
#: How often the watchdog looks whether the driving process is still its parent [s].
_LOOK = 1.0
_CHUNK = 65536
#: Longer answers are none [bytes].
_LONGEST_ANSWER = 1024
#: Answers of old firmware, which ends them with nothing, are whole so long after their beginning [s].
_WHOLE_AFTER = 0.1
#: Stands for the moment of a command that the watchdog gave by itself.
_OWN = b"inf"


class Answers:
    """Cuts the stream of a robot's answers by its protocol, whatever pieces the network makes of it.

    New firmware ends every answer with a semicolon. Old firmware ends them with nothing, or with a space: until a first
    semicolon has come, ``ok`` is a whole answer, and any other one is whole after a moment.

    Attributes:
        ended: Whether the robot ends its answers with a semicolon.
    """

    def __init__(self, ended: bool = False) -> None:
        """Begin with no bytes, from a robot of which ``ended`` may be known."""
        self.ended = ended
        self._rest = ""

    @property
    def open(self) -> bool:
        """Whether an answer has begun that only time can end."""
        return bool(self._rest.strip()) and not self.ended

    def feed(self, data: bytes) -> list[str]:
        """Take the next bytes and return the answers that they complete."""
        *whole, self._rest = (self._rest + data.decode("ascii", "replace")).split(";")
        self.ended |= bool(whole)
        found = [" ".join(answer.split()) for answer in whole]
        while not self.ended and self._rest.lstrip().startswith(OK):
            found.append(OK)
            self._rest = self._rest.lstrip()[len(OK) :]
        if len(self._rest) > _LONGEST_ANSWER:
            found += self.pause()
        return [answer for answer in found if answer]

    def pause(self) -> list[str]:
        """Return the answer that time has ended."""
        answer, self._rest = " ".join(self._rest.split()), ""
        return [answer] if answer else []


def keep(robot: socket.socket, driver: socket.socket, watchdog: float, parent: int, ended: bool) -> None:
    """Hand on commands and answers, and stop the wheels when no fresh command comes, until the driver is gone.

    A line from the driver holds the moment of a command by the monotonic clock [s] and the command; a line back holds
    the same moment, that of the answer, and the answer. Of several commands only the newest counts, and none older than
    the watchdog.

    Args:
        robot: The robot's control port, in SDK mode.
        driver: The driving process.
        watchdog: How long a command holds [s].
        parent: Process id of the driver; its forked children may hold its sockets open when it has gone.
        ended: Whether the robot ends its answers with a semicolon.

    Raises:
        OSError: The robot or the driver is lost.
    """
    waiting: deque[bytes] = deque()
    answers = Answers(ended)
    rest, deadline, begun = b"", math.inf, math.inf
    while os.getppid() == parent:
        wait = min(_LOOK, max(0.0, min(deadline, begun + _WHOLE_AFTER) - time.monotonic()))
        ready = select.select([robot, driver], [], [], wait)[0]
        if driver in ready:
            data = driver.recv(_CHUNK)
            if not data:
                return
            *lines, rest = (rest + data).split(b"\n")
            moment, _, command = lines[-1].partition(b" ") if lines else (b"-inf", b"", b"")
            if time.monotonic() < float(moment) + watchdog:
                robot.sendall(command)
                waiting.append(moment)
                deadline = float(moment) + watchdog
        found: list[str] = []
        if robot in ready:
            data = robot.recv(_CHUNK)
            if not data:
                raise ConnectionResetError("it closed the connection")
            found = answers.feed(data)
        if answers.open and time.monotonic() >= begun + _WHOLE_AFTER:
            found += answers.pause()
        begun = min(begun, time.monotonic()) if answers.open else math.inf
        for answer in found:
            moment = waiting.popleft() if waiting else _OWN
            driver.sendall(moment + f" {time.monotonic()!r} {answer}\n".encode())
        if time.monotonic() >= deadline:
            robot.sendall(STOP.encode())
            waiting.append(_OWN)
            deadline = math.inf


def leave(robot: socket.socket) -> None:
    """Stop the wheels and leave SDK mode, as far as the robot can still be reached."""
    robot.settimeout(_PATIENCE)
    for command in (STOP, QUIT):
        with suppress(OSError):
            robot.sendall(command.encode())
            robot.recv(_CHUNK)
    # A socket that is closed with unread answers resets the connection, and the robot may lose what it has not read.
    with suppress(OSError):
        robot.shutdown(socket.SHUT_WR)
        while robot.recv(_CHUNK):
            pass


def main(robot_fd: str, driver_fd: str, watchdog: str, parent: str, ended: str) -> None:
    """Keep the wheels of a robot; the arguments are those of ``keep``, sockets as file descriptors."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    with socket.socket(fileno=int(robot_fd)) as robot, socket.socket(fileno=int(driver_fd)) as driver:
        robot.settimeout(_PATIENCE)
        driver.settimeout(_PATIENCE)
        try:
            driver.sendall(f"{READY}\n".encode())
            keep(robot, driver, float(watchdog), int(parent), bool(int(ended)))
        except OSError as error:
            with suppress(OSError):
                driver.sendall(f"inf inf {error.strerror or error}\n".encode())
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            leave(robot)


if __name__ == "__main__":
    main(*sys.argv[1:])
