"""Drive one robot: its LiDAR in, its wheels out, and Algorithm 2's loop in between."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from triform.control import (
    POLICY,
    ControllerSpec,
    LearnedPolicy,
    SafetyFilter,
    SafetySettings,
    control_steps,
    drive,
    make_controller,
    sight_of,
    weights_folder,
)
from triform.control.detection import detect_robots, kernel_footprint
from triform.policy import PolicyRuntime
from triform.robots.filter import from_scans_alone, safety_settings
from triform.robots.latency import Budget
from triform.robots.ldrobot import LARGEST_INTENSITY, LidarModel, LidarPort, get_model
from triform.robots.real import RealRobot, Step
from triform.robots.recorder import Recorder
from triform.robots.robomaster import USB_ADDRESS, WIFI_ADDRESS, RoboMaster
from triform.signals import StopSignals
from triform.simulation import Drive, Footprint, Mounting, Placement, Profile, get_profile, pace, read_sectors
from triform.threads import limit_threads
from triform.types import SENSING_RANGE, Controller, Scan, ScanConfig, TriformError, View, convert_fields, require

#: How long a LiDAR may take to give its first scan, because it has to start turning [s].
_FIRST_SCAN = 8.0


@dataclass(frozen=True)
class DriveConfig:
    """Settings of a robot that drives.

    Attributes:
        lidar: Serial port of the LiDAR.
        lidar_model: Kind of LiDAR: ld06, ld19, stl-19p, ld20 or ld14p.
        address: Address of the base; 192.168.2.1, that of its own Wi-Fi, if omitted.
        usb: Whether the base is on the USB cable, at 192.168.42.2.
        local_address: Address of this computer as the base sees it; the system's choice if omitted.
        controller: Controller that needs nothing but scans: policy, policy:WEIGHTS, scan-pipeline, scan-triangulating
            or a class of your own as FILE.py:CLASS.
        distance: Prescribed neighbour distance d* [m]; the same on all robots.
        rate: Commands per second [Hz].
        profile: Robot profile, whose footprint, speed, lag and latency hold: a name or a TOML file.
        max_speed: Largest speed along x and along y [m/s]; the profile's if omitted.
        max_turn_rate: Largest turn rate [rad/s].
        watchdog: How long the base holds a command that no newer one follows [s]; at least two control periods, because
            the base has to confirm a newer one within this time.
        duration: How long to drive [s]; until Ctrl-C if omitted.
        dry_run: Whether commands are shown and not sent; no base is needed then.
        record: Folder for a recording.
        robot: Number of this robot in the recording.
        start_pose: Where it starts in the recording, x, y and heading [m, m, rad].
        seed: Of its exploration noise, different on every robot; drawn anew every time if omitted.
        mounting: Direction of the LiDAR's own zero in the robot's frame, counter-clockwise [rad]; the profile's if
            omitted, as what follows.
        lidar_position: Where the LiDAR is, forward and left of the robot's centre [m, m].
        upside_down: Whether the LiDAR hangs upside down.
        blind_sector: Sectors in which the LiDAR sees only the robot itself, each from one angle counter-clockwise to
            another [deg], such as 170:190.
        footprint: Outline of the robots: a name such as ep, circle:0.30 (diameter) or box:0.41x0.24 [m]; the profile's
            if omitted.
        odometry: Whether to use the odometry of the wheels.
        guard: Whether the safety filter keeps the robot from driving into what its scan shows.
        min_intensity: Intensity of the LiDAR, 0 to 255, from which a return is of a robot, which all wear reflecting
            tape; the controller does not see dimmer ones, and the safety filter keeps away from them. The profile's if
            omitted.
    """

    lidar: str = "/dev/ttyUSB0"
    lidar_model: str = "ld20"
    address: str | None = None
    usb: bool = False
    local_address: str | None = None
    controller: ControllerSpec = POLICY
    distance: float = 1.0
    rate: float = 8.0
    profile: str = "hardware"
    max_speed: float | None = None
    max_turn_rate: float = 1.0
    watchdog: float = 0.3
    duration: float | None = None
    dry_run: bool = False
    record: Path | None = None
    robot: int = 0
    start_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int | None = None
    mounting: float | None = None
    lidar_position: tuple[float, float] | None = None
    upside_down: bool = False
    blind_sector: tuple[str, ...] = ()
    footprint: str | None = None
    odometry: bool = True
    guard: bool = True
    min_intensity: float | None = None

    def __post_init__(self) -> None:
        convert_fields(self)
        self.kind.require_holonomic("triform drive with its RoboMaster")
        farthest = self.model.range_max / SENSING_RANGE
        require(
            0 < self.distance <= farthest,
            f"distance is {self.distance} m; it must be positive and at most {farthest:g} m, because a robot needs 2 "
            f"d* of the {self.model.range_max:g} m that its LiDAR reaches",
        )
        require(0 < self.rate < math.inf, f"rate is {self.rate} Hz; it must be positive and finite")
        speed = self.speed
        require(0 < speed < math.inf, f"max_speed is {speed} m/s; it must be positive and finite")
        require(
            0 < self.max_turn_rate < math.inf,
            f"max_turn_rate is {self.max_turn_rate} rad/s; it must be positive and finite",
        )
        require(
            2 * self.control_period <= self.watchdog < math.inf,
            f"watchdog is {self.watchdog} s; it must be finite and at least two control periods of "
            f"{self.control_period:g} s",
        )
        if self.duration is not None:
            control_steps(self.duration, self.control_period)
        require(not (self.usb and self.address), "both usb and address are given; one of them says where the base is")
        require(self.robot >= 0, f"robot is {self.robot}; it must not be negative")
        require(self.seed is None or self.seed >= 0, f"seed is {self.seed}; it must not be negative")
        require(all(map(math.isfinite, self.start_pose)), f"start_pose is {self.start_pose}; it must be finite")
        _ = SafetySettings(self.outline), self.mounted
        threshold = self.threshold
        require(
            threshold is None or 0 <= threshold <= LARGEST_INTENSITY,
            f"min_intensity is {threshold}; it must lie between 0 and {LARGEST_INTENSITY}",
        )

    @property
    def kind(self) -> Profile:
        """The robot."""
        return get_profile(self.profile)

    @property
    def speed(self) -> float:
        """Largest speed along x and along y [m/s]."""
        drive = self.kind.drive
        return min(drive.max_speed, drive.max_axis_speed) if self.max_speed is None else self.max_speed

    @property
    def shape(self) -> Footprint:
        """Outline of the robots."""
        return self.kind.footprint if self.footprint is None else Footprint.parse(self.footprint)

    @property
    def outline(self) -> tuple[float, float] | float:
        """Length and width of the robots' box, or the diameter of a circle [m]."""
        return self.shape.size

    @property
    def model(self) -> LidarModel:
        """The LiDAR."""
        return get_model(self.lidar_model)

    @property
    def threshold(self) -> float | None:
        """Intensity from which a return is of a robot; ``None`` if none is to tell."""
        return self.kind.lidar.min_intensity if self.min_intensity is None else self.min_intensity

    @property
    def mounted(self) -> Mounting:
        """How the LiDAR is mounted."""
        usual = self.kind.mounting
        x, y = (usual.x, usual.y) if self.lidar_position is None else self.lidar_position
        return Mounting(
            x,
            y,
            usual.yaw if self.mounting is None else self.mounting,
            usual.upright and not self.upside_down,
            usual.blind_sectors + read_sectors(" ".join(self.blind_sector)),
        )

    @cached_property
    def scan(self) -> ScanConfig:
        """Shape of a turn: of what its LiDAR sees, the robot uses what its controller looks at."""
        return self.model.scan_config(min(sight_of(self.controller) * self.distance, self.model.range_max))

    @property
    def placement(self) -> Placement:
        """What brings turns of the LiDAR into the robot's frame."""
        return Placement(self.scan, self.mounted, kernel_footprint(self.outline))

    @property
    def control_period(self) -> float:
        """Time between two commands [s]."""
        return 1 / self.rate

    @property
    def base_address(self) -> str:
        """Where the base is."""
        return self.address or (USB_ADDRESS if self.usb else WIFI_ADDRESS)

    @property
    def limits(self) -> Drive:
        """Speeds that commands are cut to."""
        return Drive(max_axis_speed=self.speed, max_turn_rate=self.max_turn_rate, lag=self.kind.drive.lag)

    @property
    def driven(self) -> Profile:
        """The robot as it is driven: its profile with its own LiDAR, outline, rate and limits of speed."""
        lidar = replace(self.kind.lidar, period=self.model.period, rolling=True)
        return replace(
            self.kind, footprint=self.shape, lidar=lidar, drive=self.limits, control_period=self.control_period
        )

    def make_controller(self, clock: Callable[[], object]) -> Controller[View]:
        """Make the controller, guarded if so asked.

        Args:
            clock: Called when the learned policy has made its map.

        Raises:
            TriformError: There is no such controller, it needs what a real robot cannot know, or its weights cannot be
                used.
        """
        controller: Controller[View]
        if self.controller.name == "policy":
            runtime = PolicyRuntime(weights_folder(self.controller.weights))
            controller = LearnedPolicy(runtime, self.distance, clock)
        else:
            controller = make_controller(
                self.controller, self.distance, footprint=self.outline, noise=self.kind.lidar.largest_noise
            )
        controller = from_scans_alone(controller, self.controller.label, self.threshold)
        if not self.guard:
            return controller
        return SafetyFilter(controller, safety_settings(self.driven))


class DriveListener(Protocol):
    """Hears how a robot does that drives; nothing in here may raise while wheels turn."""

    def say(self, sentence: str) -> None:
        """Hear a sentence."""
        ...

    def warn(self, sentence: str) -> None:
        """Hear a warning."""
        ...

    def driving(self) -> AbstractContextManager[Callable[[Step], None]]:
        """Give a function that hears of every step while a block runs."""
        ...

    def ended(self, summary: dict[str, Any]) -> None:
        """Hear at the end where the time went, as ``Budget.summary`` has it."""
        ...


def run_drive(config: DriveConfig, listener: DriveListener, on_view: Callable[[View], object] | None = None) -> None:
    """Drive one robot, tell how it does, and at the end where the time went.

    Args:
        config: What to drive, and how.
        listener: Hears of the steps and the latencies.
        on_view: Called with what the controller saw in every step; it may not raise while wheels turn.

    Raises:
        TriformError: The controller cannot be used, the LiDAR or the base is not there or is lost, or the folder of the
            recording cannot be used. The wheels are stopped.
        SystemExit: A signal ended the run, and all is stopped, shown and written.
    """
    budget = Budget()
    controller = config.make_controller(budget.clock)
    seed = int(np.random.SeedSequence().generate_state(1)[0]) if config.seed is None else config.seed

    with limit_threads(1), ExitStack() as stack:
        lidar = stack.enter_context(LidarPort(config.lidar, config.model, mounting=config.mounted))
        _warm_up(lidar, controller, config)
        base = None
        if not config.dry_run:
            base = RoboMaster(
                config.base_address,
                config.local_address,
                config.watchdog,
                max_speed=config.speed,
                max_turn_rate=config.max_turn_rate,
            )
            stack.enter_context(base)
        signals = stack.enter_context(StopSignals())
        recorder = None
        if config.record is not None:
            recorder = Recorder(config.record, config.scan.rays, config.robot, config.start_pose, listener.warn)
        wheels = "no wheels (dry run)"
        if base is not None:
            battery = "unknown" if base.battery is None else f"{base.battery} %"
            wheels = f"the base at {config.base_address} (battery {battery})"
        listener.say(f"{config.controller.label} drives {wheels} by the LiDAR at {config.lidar}")
        facts = {
            "settings": asdict(config) | {"seed": seed},
            "controller": controller.description,
            "began": datetime.now(UTC).isoformat(),
        }
        ended = "its time is over"
        try:
            with listener.driving() as show, _stopping(base):

                def tell(step: Step) -> None:
                    budget.add(step)
                    show(step)
                    if recorder is not None:
                        recorder.add(step)
                    if on_view is not None:
                        on_view(step.view)

                robot = RealRobot(
                    lidar,
                    base,
                    config.control_period,
                    seed,
                    config.limits,
                    placement=config.placement,
                    pace=pace(config.driven),
                    odometry=config.odometry,
                    on_sent=tell,
                    warn=listener.warn,
                )
                drive(robot, controller, config.duration or math.inf, lambda *_: signals.check())
        except BaseException as error:
            ended = str(error) or type(error).__name__
            raise
        finally:
            if recorder is not None:
                recorder.finish({**facts, "ended": ended, "latency": budget.summary()})
                listener.say(f"recorded in {config.record}")
            listener.ended(budget.summary())


@contextmanager
def _stopping(base: RoboMaster | None) -> Iterator[None]:
    """Stop the wheels when the block is left, in whatever way."""
    if base is None:
        yield
        return
    try:
        yield
    except BaseException:
        # A base that is lost cannot be told, and what went wrong first says more.
        with suppress(TriformError):
            base.stop()
        raise
    base.stop()


def _warm_up(lidar: LidarPort, controller: Controller[View], config: DriveConfig) -> None:
    """Wait for a scan and do all of a step but the wheels: compiled kernels are loaded before anything moves."""
    turn = lidar.wait(time.monotonic(), _FIRST_SCAN)
    detect_robots(Scan(turn.ranges, config.scan), config.outline)
    robot = RealRobot(lidar, None, config.control_period, 0, config.limits, placement=config.placement)
    drive(robot, controller, config.control_period)
