"""Emulated robots in one world, each driven by a ``triform drive`` process of its own, in real time."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from triform.control import ControllerSpec
from triform.evaluation import paper
from triform.evaluation.metrics import RunTable, measure
from triform.evaluation.overrides import Overrides
from triform.evaluation.rollout import Trajectory
from triform.evaluation.scenario import Scenario
from triform.recordings.description import LidarTable, RunSetting
from triform.recordings.kept import keep_runs, open_runs
from triform.recordings.measure import measure_recording
from triform.recordings.resample import read_recordings
from triform.recordings.robots import EmulationLog, with_senses
from triform.robots.emulate import STEP, EmulateConfig, Emulation, drive_command
from triform.types import TriformError, require

#: World steps between two records.
_STEPS_PER_RECORD = 10
#: How long processes may take to begin, which compile kernels after an installation, and to end [s].
_TO_BEGIN, _TO_END = 300.0, 30.0
#: All robots drive once the last one has been connected for so long: it has had a scan, and a command has followed [s].
_FIRST_STEPS = 0.5
#: A world that is farther behind shows robots nothing for longer than they wait [s].
_LATEST = 5.0


@dataclass(frozen=True)
class EmulatedRun:
    """What happened to a team of emulated robots.

    Attributes:
        trajectory: True poses since all robots drove, and what each controller saw, B = 1.
        setting: Setting of the run.
        measures: Its measures, one row.
    """

    trajectory: Trajectory
    setting: RunSetting
    measures: RunTable


def emulated_teams(scenario: Scenario, seed: int, starts: int) -> list[EmulateConfig]:
    """Return emulated robots like the paper's real ones, one team for each start.

    They are at loopback addresses that other emulations hardly use.

    Raises:
        ConfigurationError: They cannot be emulated in this scenario.
    """
    require(
        scenario.simulator == "builtin" and scenario.guard != "orca" and scenario.overrides == Overrides(),
        "Fig. 7 and 8 show emulated robots of the hardware profile as it is, behind the safety filter or none; leave "
        "simulator, guard orca and overrides out",
    )
    process = os.getpid()
    network = f"127.{100 + process % 100}.{process // 100 % 250}"
    return [
        EmulateConfig(
            paper.REAL_ROBOTS,
            seed,
            index,
            arena=scenario.arena,
            distance=scenario.distance,
            address=f"{network}.1",
            local_address=f"{network}.101",
        )
        for index in range(starts)
    ]


def drive_options(scenario: Scenario, controller: ControllerSpec) -> list[str]:
    """Return options of every ``triform drive`` of emulated robots."""
    guard = ["--no-guard"] if scenario.guard == "none" else []
    # Emulated robots endanger no people, so the commands of a busy computer may be late.
    return ["--controller", controller.label, "--watchdog", "2", *guard]


def run_emulated(
    config: EmulateConfig, options: Sequence[str], duration: float, on_record: Callable[[float], object] = float
) -> EmulatedRun:
    """Drive a team of emulated robots.

    Robots begin to drive as soon as their processes are ready, and the run begins when all of them drive.

    Args:
        config: The robots.
        options: Further options of every ``triform drive``.
        duration: How long all robots drive, at least 5 s [s].
        on_record: Called with the time that all robots have driven since it was called last [s].

    Raises:
        TriformError: The robots cannot be emulated here, or one stops; the processes have ended then.
    """
    log, moments = EmulationLog(), []
    with tempfile.TemporaryDirectory() as name, closing(Emulation(config)) as emulation:
        folder = Path(name)
        # The first steps load compiled kernels, which takes longer than any LiDAR is silent.
        while emulation.time <= config.latency + STEP:
            emulation.step()
        with _drives(config, emulation, options, folder) as drives:
            began: float | None = None
            patience = time.monotonic() + _TO_BEGIN
            for _ in _in_real_time(emulation):
                drives.check()
                if began is None:
                    if time.monotonic() > patience:
                        raise TriformError(f"a robot did not begin to drive within {_TO_BEGIN:g} s")
                    if all(base.driven for base in emulation.bases):
                        began = emulation.time + _FIRST_STEPS
                    continue
                if emulation.time < began - STEP / 2:
                    continue
                log.add(emulation)
                moments.append(time.time())
                if emulation.time - began > duration - STEP / 2:
                    break
                on_record(_STEPS_PER_RECORD * STEP)
            drives.end()
            patience = time.monotonic() + _TO_END
            for _ in _in_real_time(emulation):
                if drives.ended:
                    break
                if time.monotonic() > patience:
                    raise TriformError(f"a robot did not stop within {_TO_END:g} s")
        kept = [open_runs(drives.kept(robot)) for robot in range(config.robots)]
        seen = [each.trajectory(0, scans=True) for each in kept if each is not None]
        lidars: tuple[LidarTable, ...] = () if kept[0] is None else kept[0].description.lidars
    run = with_senses(log.trajectory, np.array(moments), seen)
    run = Trajectory(run.time - run.time[0], run.poses, run.active, run.commands, run.senses)
    setting = RunSetting(config.distance, config.kind.footprint, config.surroundings, lidars=lidars)
    contacts = log.contacts
    measures = measure(
        run,
        config.distance,
        min_distance=contacts["min_distance"],
        collision=contacts["collision"],
        hit_arena=contacts["hit_arena"],
    )
    return EmulatedRun(run, setting, {"run": np.array([config.index]), **measures})


def write_emulated(path: Path, runs: Sequence[EmulatedRun], settings: dict[str, Any]) -> None:
    """Keep runs, with the settings that they were made with, plain JSON values.

    Raises:
        TriformError: The file cannot be written.
    """
    with keep_runs(path) as writer:
        for each in runs:
            writer.add(each.trajectory, each.setting, each.measures)
        writer.describe(settings)


def read_emulated(path: Path, settings: dict[str, Any]) -> list[EmulatedRun]:
    """Return the runs that ``write_emulated`` kept with equal settings; none if there is no such file.

    Raises:
        TriformError: The file is damaged.
    """
    kept = open_runs(path) if path.exists() else None
    if kept is None or kept.description.settings != settings:
        return []
    found = []
    for number, recording in enumerate(read_recordings(path)):
        setting = kept.setting(number)
        found.append(EmulatedRun(recording.trajectory, setting, measure_recording(recording, setting)))
    return found


def _in_real_time(emulation: Emulation) -> Iterator[None]:
    """Let the world go on in real time, and yield ten times a second of it.

    Raises:
        TriformError: The computer is too slow for that.
    """
    began = time.monotonic() - emulation.time
    while True:
        for _ in range(_STEPS_PER_RECORD):
            emulation.step()
            ahead = began + emulation.time - time.monotonic()
            if ahead < -_LATEST:
                raise TriformError(
                    f"this computer is too slow or too busy to emulate robots in real time: after {emulation.time:.0f} "
                    f"s the emulated world is {-ahead:.1f} s behind"
                )
            time.sleep(max(0.0, ahead))
        yield


class _Drives:
    """Processes of ``triform drive``, one for each robot."""

    def __init__(self, folder: Path) -> None:
        """Begin without a process; they write into a folder."""
        self._folder = folder
        self._started: list[subprocess.Popen[bytes]] = []

    def kept(self, robot: int) -> Path:
        """Return where a robot keeps what it saw."""
        return self._folder / f"robot-{robot}.parquet"

    @property
    def ended(self) -> bool:
        """Whether all have ended."""
        return all(process.poll() is not None for process in self._started)

    def start(self, words: Sequence[str]) -> None:
        """Start the process of the next robot with some options.

        Raises:
            TriformError: It cannot be started.
        """
        robot = len(self._started)
        record = ["--record", str(self._folder / f"robot-{robot}"), "--keep", str(self.kept(robot)), "--scans"]
        try:
            with self._said(robot).open("wb") as file:
                command = [sys.executable, "-m", "triform", "drive", *words, *record]
                self._started.append(
                    subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT)
                )
        except OSError as error:
            raise TriformError(f"cannot start triform drive: {error.strerror or error}") from error

    def check(self) -> None:
        """Find out whether a process has ended that should not.

        Raises:
            TriformError: One has; the sentence has the last thing that it said.
        """
        for robot, process in enumerate(self._started):
            if process.poll() is not None:
                said = self._said(robot).read_text(encoding="utf-8", errors="replace").splitlines()
                reasons = [line.removeprefix("triform: ") for line in said if line.startswith("triform: ")]
                reason = reasons[-1] if reasons else f"exit status {process.returncode}"
                raise TriformError(f"triform drive of emulated robot {robot} has ended: {reason}")

    def end(self) -> None:
        """Tell all to stop, and to keep what they saw."""
        for process in self._started:
            process.terminate()

    def close(self) -> None:
        """Make sure that no process is left."""
        self.end()
        try:
            for process in self._started:
                process.wait(_TO_END)
        except subprocess.TimeoutExpired:
            pass
        finally:
            for process in self._started:
                process.kill()
                process.wait()

    def _said(self, robot: int) -> Path:
        return self._folder / f"robot-{robot}.txt"


@contextmanager
def _drives(config: EmulateConfig, emulation: Emulation, options: Sequence[str], folder: Path) -> Iterator[_Drives]:
    """Start a process for each robot, and leave none."""
    with closing(_Drives(folder)) as drives:
        for robot in range(config.robots):
            drives.start([*shlex.split(drive_command(config, emulation, robot))[2:], *options])
        yield drives
