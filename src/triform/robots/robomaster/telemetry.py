"""Odometry of a RoboMaster, from the telemetry that it pushes."""

from __future__ import annotations

import socket
import threading
import time

import numpy as np

from triform.robots.odometry import Track
from triform.robots.robomaster.protocol import RoboMasterError, read_pushed
from triform.types import FloatArray

#: How often the reader looks whether it should end [s].
_LOOK = 0.05


class Telemetry:
    """Reads the pushes of one robot in a thread of its own."""

    def __init__(self, local_address: str, port: int, robot: str, max_speed: float, max_turn_rate: float) -> None:
        """Listen for pushes.

        Args:
            local_address: Address of this computer that the robot knows.
            port: UDP port of the pushes.
            robot: The robot's address; pushes from elsewhere are passed over.
            max_speed: Largest speed that the wheels are given [m/s].
            max_turn_rate: Largest turn rate that they are given [rad/s].

        Raises:
            RoboMasterError: Another program reads pushes at this address.
        """
        self._tracks = {"position": Track([max_speed] * 2), "attitude": Track([max_turn_rate], angle=True)}
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
        position, heading = (track.at(moment) for track in self._tracks.values())
        return None if position is None or heading is None else np.append(position, heading)

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
                for name, values in read_pushed(data.decode("ascii", "replace")):
                    self._tracks[name].add(now, values)
