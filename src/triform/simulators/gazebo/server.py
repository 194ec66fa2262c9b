"""A gzserver process of our own, and lock-step with it over a socket."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import struct
import subprocess
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from triform.simulation.arena import Arena
from triform.simulation.kinematics import limit_twists
from triform.simulation.profiles import Profile
from triform.simulators.chassis import Base
from triform.simulators.gazebo.installation import Installation, find_gazebo
from triform.simulators.gazebo.sdf import write_world
from triform.types import BoolArray, FloatArray, RangeArray, TriformError, require

# The wire; lockstep.cc has the same layouts.
_REQUEST = struct.Struct("=4I")
_REPLY = struct.Struct("=2d2I")
_STATE_WIDTH = 6
_STEP, _RESET, _PLACE = 1, 2, 3

#: Loopback of the network namespace, which Gazebo's own transport needs; nothing outside can reach it.
_PRIVATE_NETWORK = 'ip link set lo up && exec "$@"'
#: $1 is the root, $2 the run folder, which appears in the root as /run.
_PRIVATE_ROOT = (
    'mount --rbind /dev "$1/dev" && mount --bind "$2" "$1/run" && ip link set lo up && '
    'root=$1 && shift 2 && exec chroot "$root" "$@"'
)
_TOOLS = ("unshare", "setpriv", "ip", "sh")
_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


class GazeboError(TriformError):
    """Gazebo is missing, has ended or does not answer."""


@dataclass(frozen=True, eq=False)
class State:
    """The world after a request. Robots that do not exist have poses of ``NaN``, twists of 0 and ranges of ``+inf``.

    Attributes:
        time: Simulated time since the last reset [s].
        active: Which robots exist, shape (N,).
        poses: True poses in the world frame, shape (N, 3) [m, m, rad].
        twists: Body twists, shape (N, 3) [m/s, m/s, rad/s].
        ranges: What every LiDAR measures now, without noise, float32 of shape (N, R) [m]; ``None`` if not asked for.
        min_distance: Smallest distance between two centres at any physics step since the last state [m].
        touched: Whether two robots touched since the last state.
        touched_arena: Whether a robot touched a wall or pillar since the last state.
    """

    time: float
    active: BoolArray
    poses: FloatArray
    twists: FloatArray
    ranges: RangeArray | None
    min_distance: float
    touched: bool
    touched_arena: bool


class GazeboServer:
    """Robots in Gazebo 11, which stands still between two requests.

    Robots wait out of sight until ``reset`` or ``add`` places them. The process ends with this object, and when the
    thread that made it ends, however that comes about. Also a context manager.

    Attributes:
        profile: Kind of all robots.
        arena: Walls and pillars.
        time_step: Step of the physics [s].
    """

    def __init__(
        self,
        profile: Profile,
        arena: Arena,
        robots: int,
        *,
        drive: Base = "planar",
        time_step: float = 0.01,
        spare: int = 0,
        timeout: float = 30.0,
        installation: Installation | None = None,
    ) -> None:
        """Start Gazebo.

        Args:
            profile: Kind of all robots: footprint, rays and the limits and lag of the base.
            arena: Walls and pillars.
            robots: Number of robots of a start.
            drive: How the robots move: by a force in the plane, or on four mecanum wheels.
            time_step: Step of the physics [s].
            spare: Number of further robots that may be added.
            timeout: Gazebo has hung if a reply takes longer [s].
            installation: Which Gazebo; by default the one that ``make gazebo`` made ready.

        Raises:
            GazeboError: If Gazebo is missing or does not start.
            ConfigurationError: If a value is outside what is allowed.
        """
        profile.require_holonomic("Gazebo")
        require(robots >= 1 and spare >= 0, f"{robots} robots and {spare} spare ones; at least 1 and 0 are needed")
        require(drive in ("planar", "mecanum"), f"drive is {drive!r}; allowed are planar, mecanum")
        require(0 < time_step < np.inf, f"time_step is {time_step} s; it must be positive and finite")
        require(0 < timeout < np.inf, f"timeout is {timeout} s; it must be positive and finite")
        found = installation or find_gazebo()
        if found is None:
            raise GazeboError("there is no Gazebo for this version of triform; run: make gazebo")
        missing = [tool for tool in _TOOLS if shutil.which(tool, path=_PATH) is None]
        if missing:
            raise GazeboError(f"Gazebo cannot be kept private without {missing[0]}; install util-linux and iproute2")
        self.profile, self.arena, self.time_step = profile, arena, time_step
        self._rays = profile.lidar.scan.rays
        self._active = np.zeros(robots + spare, dtype=np.bool_)
        self._placed = np.full((robots + spare, 3), np.nan)
        self._timeout = timeout
        self._open = ExitStack()
        self._log = os.fdopen(os.memfd_create("gzserver-log"), "r+b")
        self._open.enter_context(self._log)
        self._socket, theirs = (self._open.enter_context(end) for end in socket.socketpair())
        self._socket.settimeout(timeout)
        self._process: subprocess.Popen[bytes] | None = None
        try:
            with tempfile.TemporaryDirectory(prefix="triform-gazebo-", ignore_cleanup_errors=True) as folder:
                self._start(found, Path(folder), theirs, write_world(
                    profile, arena, robots + spare, drive, time_step,
                    "/run/liblockstep.so" if found.root else f"{folder}/liblockstep.so",
                ))  # fmt: skip
                theirs.close()
                # The first reply comes when everything is loaded; then nobody needs the folder.
                self.reset(self._placed)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> GazeboServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def active(self) -> BoolArray:
        """Which robots exist, shape (N,)."""
        return self._active.copy()

    @property
    def pid(self) -> int | None:
        """Number of the process; ``None`` when it has been closed."""
        return None if self._process is None else self._process.pid

    def step(self, commands: ArrayLike, steps: int, scan: bool = True) -> State:
        """Hold body twists for some steps of the physics.

        Args:
            commands: Body twists, shape (N, 3) [m/s, m/s, rad/s], which are limited as in the built-in world; those of
                robots that do not exist are not used.
            steps: How many; 0 only looks.
            scan: Whether to measure with every LiDAR afterwards.

        Raises:
            GazeboError: If Gazebo has ended or hangs.
            TriformError: If the shape does not fit or a command is not finite.
        """
        values = np.array(commands, dtype=np.float64)
        if values.shape != self._placed.shape:
            raise TriformError(f"commands of shape {values.shape} given; {self._placed.shape} is needed")
        values[~self._active] = 0.0
        if not np.isfinite(values).all():
            robot = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
            raise TriformError(f"the command {values[robot]} of robot {robot} is not finite")
        if not 0 <= steps < 2**32:
            raise TriformError(f"{steps} steps given; a number from 0 on is needed")
        return self._request(_STEP, limit_twists(values, self.profile.drive), steps=steps, scan=scan)

    def reset(self, poses: ArrayLike, scan: bool = False) -> State:
        """Place robots at rest, clear contacts and set time to 0.

        Args:
            poses: Poses in the world frame, shape (up to N, 3) [m, m, rad]; robots with ``NaN`` and those beyond the
                last row do not exist.
            scan: Whether to measure with every LiDAR.

        Raises:
            GazeboError: If Gazebo has ended or hangs.
            TriformError: If the shape does not fit or a pose is infinite.
        """
        given = np.array(poses, dtype=np.float64)
        if given.ndim != 2 or given.shape[1] != 3 or len(given) > len(self._active):
            raise TriformError(f"poses of shape {given.shape} given; at most {self._placed.shape} is needed")
        if np.isinf(given).any():
            raise TriformError("a pose is infinite; it must be finite, or NaN for a robot that does not exist")
        placed = np.full_like(self._placed, np.nan)
        placed[: len(given)] = given
        placed[np.isnan(placed).any(axis=1)] = np.nan
        self._active = np.isfinite(placed[:, 0])
        return self._request(_RESET, placed, scan=scan)

    def add(self, pose: ArrayLike) -> int:
        """Place one more robot at rest and return its index.

        Raises:
            GazeboError: If Gazebo has ended or hangs.
            TriformError: If no robot is spare or the pose is not three finite numbers.
        """
        placed = np.array(pose, dtype=np.float64)
        if placed.shape != (3,) or not np.isfinite(placed).all():
            raise TriformError(f"a robot cannot be placed at {placed}; a pose is three finite numbers")
        free = np.flatnonzero(~self._active)
        if len(free) == 0:
            raise TriformError(f"all {len(self._active)} robots exist already; ask for more spare ones")
        robot = int(free[0])
        self._place(robot, placed)
        return robot

    def remove(self, robot: int) -> None:
        """Take a robot out of the world.

        Raises:
            GazeboError: If Gazebo has ended or hangs.
            TriformError: If there is no such robot.
        """
        if not 0 <= robot < len(self._active) or not self._active[robot]:
            raise TriformError(f"there is no robot {robot}; robots are {np.flatnonzero(self._active).tolist()}")
        self._place(robot, np.full(3, np.nan))

    def close(self) -> None:
        """End Gazebo; a second time does nothing."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
        self._open.close()

    def _start(self, found: Installation, folder: Path, theirs: socket.socket, world: str) -> None:
        """Start gzserver in a network namespace of its own."""
        (folder / "world.sdf").write_text(world)
        shutil.copy(found.plugin, folder / "liblockstep.so")
        seen = Path("/run") if found.root else folder
        # What is installed may need the caller's LD_LIBRARY_PATH; a private root must see nothing of this machine.
        environment = {} if found.root else dict(os.environ)
        environment |= {
            "PATH": _PATH if found.root else f"{os.environ.get('PATH', '')}:{_PATH}",
            "HOME": str(seen),
            "LC_ALL": "C",
            "GAZEBO_MASTER_URI": "http://127.0.0.1:11345",
            "GAZEBO_IP": "127.0.0.1",
            "IGN_IP": "127.0.0.1",
            "GAZEBO_MODEL_DATABASE_URI": "",
            "ALSOFT_DRIVERS": "null",
            "TRIFORM_GAZEBO_SOCKET": str(theirs.fileno()),
        }
        spaces = ["--net", "--mount"] if os.geteuid() == 0 else ["--user", "--map-root-user", "--net", "--mount"]
        script = [_PRIVATE_ROOT, "sh", str(found.root), str(folder)] if found.root else [_PRIVATE_NETWORK, "sh"]
        # A new user namespace would clear the death signal, so it comes after.
        command = ["unshare", *spaces, "setpriv", "--pdeathsig", "KILL", "sh", "-c", *script]
        self._process = subprocess.Popen(
            [*command, "gzserver", str(seen / "world.sdf")],
            env=environment, cwd="/", stdin=subprocess.DEVNULL, stdout=self._log, stderr=self._log,
            pass_fds=[theirs.fileno()], start_new_session=True,
        )  # fmt: skip

    def _place(self, robot: int, pose: FloatArray) -> None:
        values = np.full_like(self._placed, np.nan)
        values[robot] = pose
        self._request(_PLACE, values, robot=robot)
        self._active[robot] = np.isfinite(pose[0])

    def _request(
        self, operation: int, values: FloatArray, *, steps: int = 0, scan: bool = False, robot: int = 0
    ) -> State:
        if self._process is None:
            raise GazeboError("this Gazebo has been closed")
        robots = len(values)
        row = 8 * _STATE_WIDTH + (4 * self._rays if scan else 0)
        try:
            self._socket.sendall(_REQUEST.pack(operation, steps, scan, robot) + values.tobytes())
            reply = self._receive(_REPLY.size + robots * row)
        except TimeoutError:
            raise self._lost(f"Gazebo has not answered for {self._timeout:g} s") from None
        except OSError as error:
            raise self._lost(self._how_it_ended()) from error
        except BaseException:
            # An interrupted request leaves a reply behind that the next one would take for its own.
            self.close()
            raise
        time, min_distance, touched, touched_arena = _REPLY.unpack_from(reply)
        state = np.frombuffer(reply, np.float64, robots * _STATE_WIDTH, _REPLY.size).reshape(robots, _STATE_WIDTH)
        poses = np.where(self._active[:, None], state[:, :3], np.nan)
        twists = np.where(self._active[:, None], state[:, 3:], 0.0)
        ranges = None
        if scan:
            start = _REPLY.size + robots * _STATE_WIDTH * 8
            ranges = np.frombuffer(reply, np.float32, robots * self._rays, start).reshape(robots, self._rays)
        return State(time, self.active, poses, twists, ranges, min_distance, bool(touched), bool(touched_arena))

    def _receive(self, size: int) -> bytearray:
        data = bytearray(size)
        place = memoryview(data)
        while place:
            got = self._socket.recv_into(place)
            if got == 0:
                raise ConnectionResetError
            place = place[got:]
        return data

    def _how_it_ended(self) -> str:
        """Say how the process ended, whose end of the connection is closed."""
        assert self._process is not None
        try:
            status = self._process.wait(self._timeout)
        except subprocess.TimeoutExpired:
            return "Gazebo has closed the connection"
        if status < 0:
            return f"Gazebo was ended by {signal.Signals(-status).name}"
        return f"Gazebo ended with status {status}"

    def _lost(self, what: str) -> GazeboError:
        """Close everything and say ``what`` happened with the end of the log."""
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").split("\n")
        last = [line.strip() for line in lines if line.strip()][-3:]
        self.close()
        return GazeboError(f"{what}; its last words: {' / '.join(last)}" if last else what)
