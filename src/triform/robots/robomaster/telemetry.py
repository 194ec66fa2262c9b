"""Odometry of a RoboMaster, from the telemetry that it pushes."""

from __future__ import annotations

import socket
import threading
import time
from collections import deque

import numpy as np

from triform.robots.robomaster.protocol import RoboMasterError, read_pushed
from triform.types import FloatArray

#: How far past the newest push a pose is told [s].
EXTRAPOLATION = 0.2

#: Pushes that are remembered: five seconds at 20 Hz.
_REMEMBERED = 100
#: Speeds are taken over at least this time [s]: pushes that were held up come in bunches.
_RATE_TIME = 0.1
#: How often the reader looks whether it should end [s].
_LOOK = 0.05


class Track:
    """Numbers that change with time, known at some moments."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=_REMEMBERED)
        self._values: deque[FloatArray] = deque(maxlen=_REMEMBERED)

    @property
    def newest(self) -> FloatArray | None:
        """The newest numbers."""
        return self._values[-1] if self._values else None

    def add(self, moment: float, values: FloatArray) -> None:
        """Remember numbers of a moment [s], later than all before."""
        self._times.append(moment)
        self._values.append(values)

    def at(self, moment: float) -> FloatArray | None:
        """Numbers at a moment [s]: between known ones, or ahead of the newest one at the last speed."""
        if not self._times or not self._times[0] <= moment <= self._times[-1] + EXTRAPOLATION:
            return None
        times, values = np.array(self._times), np.array(self._values)
        earlier = np.flatnonzero(times <= times[-1] - _RATE_TIME)
        if moment > times[-1] and earlier.size:
            first = earlier[-1]
            rate = (values[-1] - values[first]) / (times[-1] - times[first])
            return np.asarray(values[-1] + rate * (moment - times[-1]))
        return np.array([np.interp(moment, times, column) for column in values.T])


class Telemetry:
    """Reads the pushes of one robot in a thread of its own."""

    def __init__(self, local_address: str, port: int, robot: str) -> None:
        """Listen for pushes.

        Args:
            local_address: Address of this computer that the robot knows.
            port: UDP port of the pushes.
            robot: The robot's address; pushes from elsewhere are passed over.

        Raises:
            RoboMasterError: Another program reads pushes at this address.
        """
        self._tracks = {"position": Track(), "attitude": Track()}
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._robot = robot
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(_LOOK)
        try:
            self._socket.bind((local_address, port))
        except OSError as error:
            self._socket.close()
            raise RoboMasterError(
                f"cannot listen for telemetry at {local_address}:{port} ({error.strerror}): "
                "each robot that one computer drives needs its own local address"
            ) from error
        self._reader = threading.Thread(target=self._read, name="robomaster-telemetry", daemon=True)
        self._reader.start()

    def pose(self, moment: float) -> FloatArray | None:
        """Pose at a moment of the monotonic clock [s], REP 103, shape (3,) [m, m, rad]; ``None`` if it is not known."""
        with self._lock:
            position, heading = self._tracks["position"].at(moment), self._tracks["attitude"].at(moment)
        if position is None or heading is None:
            return None
        return np.append(position, (heading + np.pi) % (2 * np.pi) - np.pi)

    def close(self) -> None:
        """Listen no more."""
        self._closing.set()
        self._reader.join()
        self._socket.close()

    def _read(self) -> None:
        while not self._closing.is_set():
            try:
                data, sender = self._socket.recvfrom(4096)
            except TimeoutError:
                continue
            except OSError:
                # The network is gone; soon no pose is known any more.
                return
            now = time.monotonic()
            if sender[0] == self._robot:
                with self._lock:
                    for name, values in read_pushed(data.decode("ascii", "replace")):
                        self._add(name, now, values)

    def _add(self, name: str, now: float, values: FloatArray) -> None:
        track = self._tracks[name]
        if name == "attitude" and track.newest is not None:
            # Headings go on past half a turn, so that one can tell what lies between two.
            values = track.newest + (values - track.newest + np.pi) % (2 * np.pi) - np.pi
        track.add(now, values)
