"""A LiDAR on a serial port."""

from __future__ import annotations

import errno
import os
import threading
import time
from pathlib import Path
from types import TracebackType

from triform.robots.laser_scan import Turn
from triform.robots.ldrobot.models import LidarModel
from triform.robots.ldrobot.packets import BAUD, LINE_RATE, PacketParser
from triform.robots.ldrobot.turns import LONGEST_GAP, TurnAssembler
from triform.simulation.mounting import Mounting
from triform.types import ScanConfig, TriformError

#: A LiDAR that is silent for longer is lost [s].
LONGEST_SILENCE = 1.0
#: Bytes without a packet for longer come from something else, or at another speed [s].
LONGEST_NONSENSE = 2.0
#: Bytes are left to gather for so long [s]: to look at every packet by itself takes three times the computing.
READ_PERIOD = 0.01
#: A read waits for bytes no longer than this [s].
_READ_TIMEOUT = 0.1


class LidarError(TriformError):
    """The port of a LiDAR cannot be opened, or is lost, or something else is connected to it."""


class LidarPort:
    """A LiDAR whose turns a thread of its own reads from a serial port until the port is closed.

    A port that has failed stays so: whatever is asked of it raises ``LidarError``.

    Attributes:
        path: The serial port.
        scan: The grid of its turns.
        parser: Counts what has been read.
    """

    def __init__(
        self, path: str | Path, model: LidarModel, scan: ScanConfig | None = None, mounting: Mounting | None = None
    ) -> None:
        """Open a port and begin to read. Needs the extra ``robot``.

        Args:
            path: The serial port, such as ``/dev/ttyUSB0``.
            model: The LiDAR.
            scan: Rays and limits of range; those of the model if ``None``.
            mounting: How the LiDAR is mounted, see ``TurnAssembler``.

        Raises:
            LidarError: If the port cannot be opened, or another program reads it.
        """
        import serial

        self.path = Path(path)
        self.parser = PacketParser()
        self._turns = TurnAssembler(model, scan, mounting)
        self.scan = self._turns.scan
        try:
            self._port = serial.Serial(str(path), BAUD, timeout=_READ_TIMEOUT, exclusive=True)
        except OSError as error:
            reason = os.strerror(error.errno) if error.errno else str(error)
            if error.errno == errno.EWOULDBLOCK:
                reason = "another program reads it"
            raise LidarError(f"cannot open the LiDAR's port {path}: {reason}") from error
        self._news = threading.Condition()
        self._latest: Turn | None = None
        self._failure: str | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._read, name=f"LiDAR {path}", daemon=True)
        self._thread.start()

    def __enter__(self) -> LidarPort:
        """Return the open port."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the port."""
        self.close()

    def close(self) -> None:
        """End the thread and close the port; a closed port may be closed again."""
        self._closing = True
        self._thread.join()
        self._port.close()
        with self._news:
            self._failure = self._failure or f"the LiDAR's port {self.path} has been closed"
            self._news.notify_all()

    def latest(self) -> Turn | None:
        """Return the newest finished turn; ``None`` before the first.

        Raises:
            LidarError: If the LiDAR is lost.
        """
        with self._news:
            if self._failure:
                raise LidarError(self._failure)
            return self._latest

    def wait(self, after: float, timeout: float) -> Turn:
        """Return the newest turn that ended later than ``after``, and wait for it if need be.

        Args:
            after: A moment of the host's monotonic clock [s].
            timeout: Longest wait [s].

        Raises:
            LidarError: If the LiDAR is lost, or no such turn comes in time.
        """
        with self._news:
            self._news.wait_for(lambda: bool(self._failure or self._newer(after)), timeout)
            if self._failure:
                raise LidarError(self._failure)
            turn = self._newer(after)
        if turn is None:
            raise LidarError(f"the LiDAR at {self.path} has finished no turn within {timeout:g} s")
        return turn

    def _newer(self, after: float) -> Turn | None:
        return self._latest if self._latest and self._latest.ended > after else None

    def _read(self) -> None:
        """Read until the port is closed or fails."""
        failure = None
        silent = puzzled = 0.0
        held_up = False
        before = time.monotonic()
        while not self._closing and failure is None:
            time.sleep(READ_PERIOD)
            try:
                data = self._port.read(max(1, self._port.in_waiting))
            except OSError as error:
                failure = f"the LiDAR at {self.path} is lost: {error}"
                continue
            now = time.monotonic()
            # What waited while this thread did not run for long would pass for news. A buffer is faster than the line.
            held_up = now - before > LONGEST_GAP or (held_up and len(data) > LINE_RATE * (now - before))
            if held_up:
                data = b""
            packets = self.parser.feed(data)
            # Time that the machine did not give to this thread says nothing about the LiDAR.
            passed, before = min(now - before, 2 * _READ_TIMEOUT), now
            silent = 0.0 if data else silent + passed
            puzzled = 0.0 if len(packets) else puzzled + passed
            if silent > LONGEST_SILENCE:
                failure = f"the LiDAR at {self.path} has sent nothing for {LONGEST_SILENCE:g} s; is it powered?"
            elif puzzled > LONGEST_NONSENSE:
                failure = (
                    f"what sends at {self.path} is no LDROBOT LiDAR at {BAUD} baud: no packet in "
                    f"{LONGEST_NONSENSE:g} s, only other bytes"
                )
            for turn in self._turns.add(packets, now):
                self._publish(turn)
        if failure:
            with self._news:
                self._failure = failure
                self._news.notify_all()

    def _publish(self, turn: Turn) -> None:
        with self._news:
            self._latest = turn
            self._news.notify_all()
