"""One real robot: a LiDAR and a base, driven by the same loop as the built-in world."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from triform.control.sight import BLIND_TURNS, Sight, has_sight
from triform.robots.laser_scan import Turn
from triform.robots.odometry import is_motion, is_place
from triform.simulation import Drive, Placement, limit_twists
from triform.simulation.noise import noise_in_body, noise_keys
from triform.simulation.odometry import relative_poses, resting_poses
from triform.types import FloatArray, RangeArray, Scan, ScanConfig, TriformError, View, require

#: A robot's velocity is taken over this long [s].
_SPEED_TIME = 0.1
_ONE = np.ones((1, 1), dtype=np.bool_)
_NO_SCAN = "there is no scan that can be used"


class Lidar(Protocol):
    """A LiDAR that turns and turns."""

    @property
    def scan(self) -> ScanConfig:
        """Shape of its turns."""
        ...

    def latest(self) -> Turn | None:
        """Return the newest finished turn; ``None`` before the first one.

        Raises:
            TriformError: The LiDAR is lost.
        """
        ...


class Base(Protocol):
    """Wheels."""

    def drive(self, command: FloatArray) -> None:
        """Hold a body twist, shape (3,) [m/s, m/s, rad/s], until the next one.

        Raises:
            TriformError: The base is lost.
        """
        ...

    def stop(self) -> None:
        """Stop the wheels.

        Raises:
            TriformError: The base is lost.
        """
        ...

    def odometry(self, at: float) -> FloatArray | None:
        """Return the pose at a moment of the host's monotonic clock [s], shape (3,); ``None`` if it is not known."""
        ...


@dataclass(frozen=True)
class Step:
    """One control period of a real robot, told when its command has been sent.

    Attributes:
        seen: When the robot looked for its newest scan, by the host's monotonic clock [s].
        decided: When its command was known [s].
        sent: When the base had it [s].
        turn: The newest turn of the LiDAR; ``None`` before the first one.
        view: What the controller saw.
        command: The body twist that was sent, shape (3,) [m/s, m/s, rad/s].
        pose: Odometry now, shape (3,) [m, m, rad]; ``None`` if it is not known.
        blind: Whether the robot stood still for want of a fresh scan.
        late: Whether the command came after its control period had ended.
    """

    seen: float
    decided: float
    sent: float
    turn: Turn | None
    view: View
    command: FloatArray
    pose: FloatArray | None
    blind: bool
    late: bool

    @property
    def scan_age(self) -> float:
        """Time from the end of the scan until it was used [s]; ``NaN`` before the first one."""
        return math.nan if self.turn is None else self.seen - self.turn.ended

    @property
    def latency(self) -> float:
        """Time from the end of the scan until the base had the command [s]; ``NaN`` before the first scan."""
        return math.nan if self.turn is None else self.sent - self.turn.ended


class RealRobot:
    """A LiDAR and a base: a ``Team[View]`` of one robot, B = N = 1.

    The robot decides at the ticks of a steady clock. What a late command costs is not made up for: the clock starts
    anew from it.

    A robot without a fresh scan, or whose scans show nothing for some turns (``triform.control.sight``), stands still,
    whatever its controller says. So does a differential base whose odometry is used and does not come: the safety
    filter bounds its arcs from where it comes to rest. What can only be the robot itself is unknown to its controller.

    Attributes:
        control_period: Time between two commands [s].
        late_ticks: Commands that came after their control period had ended.
        standing: Why the robot stands still whatever its controller says; empty while it obeys its controller.
    """

    def __init__(
        self,
        lidar: Lidar,
        base: Base | None,
        control_period: float,
        seed: int,
        limits: Drive,
        *,
        placement: Placement | None = None,
        pace: float = 1.0,
        odometry: bool = True,
        scan_timeout: float = 0.5,
        on_sent: Callable[[Step], None] | None = None,
        warn: Callable[[str], None] | None = None,
    ) -> None:
        """Take charge of a LiDAR and a base.

        Args:
            lidar: Gives the scans.
            base: Takes the commands; ``None`` drives nothing and knows no odometry.
            control_period: Time between two commands [s].
            seed: Of the exploration noise; robots of one team need different ones.
            limits: Commands are cut to these speeds.
            placement: Brings turns of the LiDAR into the frame of the base; they are there if omitted.
            pace: Share of full speed that its safety filter drives; its noise lasts longer in proportion.
            odometry: Whether a view says how far the robot has come since its scan.
            scan_timeout: An older scan is no scan [s].
            on_sent: Called when a command has been sent, before the robot waits for its next tick.
            warn: Called with a sentence when scans stop coming or show nothing, and once if they show the robot itself.

        Raises:
            ConfigurationError: A time is not positive.
        """
        require(0 < control_period < math.inf, f"control_period is {control_period} s; it must be positive and finite")
        require(0 < scan_timeout < math.inf, f"scan_timeout is {scan_timeout} s; it must be positive and finite")
        self._lidar, self._base = lidar, base
        self._placement = placement or Placement(lidar.scan)
        self._sight = Sight()
        self.control_period = control_period
        self._limits, self._pace = limits, pace
        self._keys = noise_keys([np.random.SeedSequence(seed)], 1)
        self._odometry = odometry
        self._timeout = scan_timeout
        self._on_sent, self._warn = on_sent, warn
        self._turn: Turn | None = None
        self._view: View | None = None
        self._ranges: RangeArray = np.full(self._placement.scan.rays, np.inf, np.float32)
        self._intensities: RangeArray | None = None
        self.standing = _NO_SCAN
        self._warned = False
        self._shows_itself = False
        self.late_ticks = 0
        self._started = self._seen = self._due = self._placed = time.monotonic()

    def observe(self) -> View:
        """Return the newest scan, as seen from the base's centre; ``+inf`` before the first one, ``NaN`` if too old.

        Raises:
            TriformError: The LiDAR is lost.
        """
        last, self._turn = self._turn, self._lidar.latest()
        turn = self._turn
        self._seen = now = time.monotonic()
        if turn is not None and (last is None or turn.ended > last.ended):
            self._look(turn)
        then, resting = (None, None) if turn is None else self._poses(turn, now)
        old = turn is not None and now - turn.ended > self._timeout
        self.standing = self._reason_to_stand(old, resting is not None)
        ranges = self._ranges
        if turn is None or old:
            ranges = np.full_like(ranges, np.nan if old else np.inf)
        bright = self._intensities
        heading = np.zeros((1, 1)) if resting is None else resting[..., 2]
        moved = None if then is None or resting is None else relative_poses(resting, then, _ONE)
        self._view = View(
            scans=Scan(ranges[None, None], self._placement.scan, None if bright is None else bright[None, None]),
            active=_ONE,
            time=now - self._started,
            noise=noise_in_body(self._keys, self._limits, now - self._started, heading, pace=self._pace),
            odometry=moved,
        )
        return self._view

    def apply(self, commands: FloatArray, duration: float) -> None:
        """Send a command and wait for the next tick.

        Args:
            commands: Body twist, shape (1, 1, 3) [m/s, m/s, rad/s].
            duration: From this tick to the next [s].

        Raises:
            TriformError: The base is lost, or the command is no three finite numbers.
        """
        if commands.shape != (1, 1, 3) or not np.isfinite(commands).all():
            raise TriformError(f"the command {commands} cannot be driven; three finite numbers are needed")
        decided = time.monotonic()
        blind = self.standing != ""
        command = np.zeros(3) if blind else self._sight.trust * limit_twists(commands, self._limits)[0, 0]
        if self._base is not None:
            self._base.drive(command)
        sent = time.monotonic()
        self._due += duration
        late = sent > self._due
        if late:
            self.late_ticks += 1
            self._due = sent
        if self._on_sent is not None and self._view is not None:
            pose = None if self._base is None else self._base.odometry(sent)
            self._on_sent(Step(self._seen, decided, sent, self._turn, self._view, command, pose, blind, late))
        time.sleep(max(0.0, self._due - time.monotonic()))

    def _reason_to_stand(self, old: bool, placed: bool) -> str:
        """Return why the robot stands still, and warn when it begins to; empty while the robot obeys its controller."""
        if placed:
            self._placed = self._seen
        reason, patience = "", 0.0
        if self._turn is None:
            return _NO_SCAN
        if old:
            reason = f"no new scan for {self._timeout:g} s: the robot stands still until one comes"
        elif self._sight.trust == 0:
            reason = (
                f"the LiDAR has shown nothing, or less than half of its surroundings, for {BLIND_TURNS} turns: the "
                "robot stands still until it sees again"
            )
        elif self._limits.is_differential and self._odometry and not placed:
            reason = "the odometry of the wheels is missing or leaps: the robot stands still until it is known"
            patience = self._timeout
        warns = reason != "" and self._seen - self._placed >= patience
        if warns and not self._warned and self._warn is not None:
            self._warn(reason)
        self._warned = reason != "" and (warns or self._warned)
        return reason

    def _look(self, turn: Turn) -> None:
        """Take a new turn: whether it has sight, and what it shows of the surroundings."""
        placement = self._placement
        masked = placement.masked(turn.ranges)
        own = np.isnan(masked) & ~np.isnan(turn.ranges) & placement.looks
        if own.any() and not self._shows_itself and self._warn is not None:
            degrees = np.degrees(placement.scan.angles[own])
            self._warn(
                f"{own.sum()} rays, the first at {degrees[0]:.0f} degrees, end within the robot's own outline: what "
                "they show is unknown, as in a blind sector"
            )
        self._shows_itself |= bool(own.any())
        self._sight.note(has_sight(masked, placement.looks))
        self._ranges, self._intensities = placement.from_base(masked, turn.intensities)

    def _poses(self, turn: Turn, now: float) -> tuple[FloatArray | None, FloatArray | None]:
        """Poses in the middle of a turn and at rest after now, shape (1, 1, 3).

        ``None`` if they are not known, or if the robot cannot have moved as its odometry says.
        """
        if self._base is None or not self._odometry:
            return None, None
        moments = ((turn.started + turn.ended) / 2, now - _SPEED_TIME, now)
        then, before, here = (self._base.odometry(moment) for moment in moments)
        if then is None or before is None or here is None or not is_place(np.array([then, before, here])):
            return None, None
        speed = min(self._limits.max_speed, math.sqrt(2) * self._limits.max_axis_speed)
        fastest = np.array([speed, speed, self._limits.max_turn_rate])
        come, last = (relative_poses(here[None, None], pose[None, None], _ONE) for pose in (then, before))
        if not (is_motion(come, now - moments[0], fastest) and is_motion(last, _SPEED_TIME, fastest)):
            return None, None
        return then[None, None], resting_poses(here[None, None], last / _SPEED_TIME, self._limits)
