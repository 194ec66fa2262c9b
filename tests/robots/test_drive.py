"""``triform drive``: from LiDAR to wheels, with the hardware replaced by what its drivers promise."""

from __future__ import annotations

import csv
import io
import json
import os
import resource
import signal
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from triform.commands.drive_screen import DriveScreen, StatusLine
from triform.commands.screen import Screen
from triform.control import ControllerSpec
from triform.robots import drive as drive_module
from triform.robots.drive import DriveConfig, run_drive
from triform.robots.laser_scan import Turn
from triform.robots.latency import Budget, Durations
from triform.robots.ldrobot import LidarModel
from triform.robots.real import Step
from triform.robots.recorder import CsvLog
from triform.robots.scan_file import read_scans
from triform.signals import StopSignals
from triform.simulation import HARDWARE, ROBOMASTER_EP, Arena, Mounting, cast_scans, profile_toml
from triform.types import ConfigurationError, Scan, ScanConfig, TriformError, View


class FakeLidar:
    """Sees one robot 0.6 m ahead, in turns of 1/6 s that follow each other without a gap."""

    lost_after: float | None = None
    silent_after: float | None = None

    def __init__(self, path: str, model: LidarModel, mounting: Mounting) -> None:
        self.scan, self.began = model.scan_config(), time.monotonic()
        poses = np.array([[[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]]])
        exact = cast_scans(poses, np.ones((1, 2), bool), ROBOMASTER_EP, Arena.open(), self.scan, dtype=np.float32)
        self.ranges = exact[0, 0]
        self.intensities = np.where(np.isfinite(self.ranges), 240, 0).astype(np.float32)

    def __enter__(self) -> FakeLidar:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def latest(self) -> Turn | None:
        passed = time.monotonic() - self.began
        if self.lost_after is not None and passed > self.lost_after:
            raise TriformError("the LiDAR is lost")
        turn = int(min(passed, self.silent_after or np.inf) * 6)
        return Turn(self.ranges, self.began + (turn - 1) / 6, self.began + turn / 6, self.intensities)

    def wait(self, after: float, timeout: float) -> Turn:
        turn = self.latest()
        assert turn is not None
        return turn


class FakeBase:
    """Takes commands; from the fifth on it may be lost, or a signal comes with it."""

    lost = False
    signal: int | None = None
    battery = 73

    def __init__(self, *_: object, **__: object) -> None:
        self.commands: list[np.ndarray] = []
        self.stops = 0
        made.append(self)

    def __enter__(self) -> FakeBase:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def drive(self, command: np.ndarray) -> None:
        if self.lost and len(self.commands) == 4:
            raise TriformError("the base is lost")
        self.commands.append(command)
        if self.signal is not None and len(self.commands) == 5:
            os.kill(os.getpid(), self.signal)

    def stop(self) -> None:
        self.stops += 1
        if self.lost:
            raise TriformError("the base cannot be stopped")

    def odometry(self, at: float) -> np.ndarray | None:
        return np.array([1.0, 2.0, 0.5])


made: list[FakeBase] = []
SCAN_PIPELINE = ControllerSpec("scan-pipeline")


@pytest.fixture(autouse=True)
def fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    made.clear()
    monkeypatch.setattr(drive_module, "LidarPort", FakeLidar)
    monkeypatch.setattr(drive_module, "RoboMaster", FakeBase)


def screen_of(config: DriveConfig, console: Console) -> DriveScreen:
    return DriveScreen(console, config.outline, config.dry_run, config.threshold)


def run(config: DriveConfig, shown: io.StringIO | None = None) -> str:
    """Drive and return what was printed, which is also in ``shown``."""
    shown = shown or io.StringIO()
    run_drive(config, screen_of(config, Console(file=shown, width=200)))
    return shown.getvalue()


def test_drives_away_from_a_robot_that_is_too_near_and_stops_at_the_end() -> None:
    said = run(DriveConfig(controller=SCAN_PIPELINE, duration=1.5, rate=20.0))
    (base,) = made
    assert len(base.commands) == 30
    assert base.stops == 1
    commands = np.array(base.commands)
    assert (np.abs(commands[:, :2]) <= 0.1).all()
    # The guard has the robot wait until it can be sure of a scan; a robot nearer than d* is then fled.
    assert commands[-1, 0] == pytest.approx(-0.1)
    assert "neighbours 1" in said
    assert "30 commands" in said
    assert "(battery 73 %)" in said
    assert "scans used" in said


def test_a_dry_run_needs_no_base_and_sends_nothing() -> None:
    said = run(DriveConfig(controller=SCAN_PIPELINE, duration=1.5, rate=20.0, dry_run=True))
    assert made == []
    assert "would send -0.10" in said


def test_what_is_dimmer_than_tape_is_no_neighbour_and_stops_the_robot_all_the_same() -> None:
    """A robot 0.6 m ahead is fled; the same return without tape is not, and nobody drives into it."""
    for threshold, flees in ((230.0, True), (250.0, False)):
        said = run(DriveConfig(controller=SCAN_PIPELINE, duration=1.5, rate=20.0, min_intensity=threshold))
        assert f"neighbours {int(flees)}" in said
        commands = np.array(made[-1].commands)
        assert (commands[-1, 0] == pytest.approx(-0.1)) == flees
    with pytest.raises(ConfigurationError, match=r"min_intensity is 300; it must lie between 0 and 255"):
        DriveConfig(min_intensity=300)


def test_the_budget_tells_map_from_policy() -> None:
    said = run(DriveConfig(duration=1.0, rate=20.0, seed=1))
    lines = {line.split()[0]: line.split()[1:4] for line in said.splitlines() if line.strip()}
    for part in ("sense", "map", "policy", "send", "total"):
        median, p95, most = map(float, lines[part])
        assert 0 <= median <= p95 <= most


def test_the_recording_says_what_was_seen_and_done(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    before = time.time()
    config = DriveConfig(
        controller=SCAN_PIPELINE, duration=1.0, rate=10.0, record=folder, robot=3, start_pose=(5.0, -1.0, 1.0), seed=8
    )
    run(config)
    with (folder / "steps.csv").open() as file:
        steps = list(csv.DictReader(file))
    assert len(steps) == 10
    time_of = [float(step["time"]) for step in steps]
    assert time_of == sorted(time_of)
    assert before <= time_of[0] + 1e-3 <= time_of[-1] <= time.time() + 1e-3
    for step, command in zip(steps, made[0].commands, strict=True):
        assert step["robot"] == "3"
        # The wheels say that the robot has not moved, so it is where it started.
        np.testing.assert_allclose([float(step[name]) for name in ("x", "y", "heading")], [5.0, -1.0, 1.0], atol=1e-6)
        np.testing.assert_allclose([float(step[name]) for name in ("u_x", "u_y", "omega")], command, atol=1e-6)
        assert 0 <= float(step["scan_age"]) <= float(step["latency"])
    with (folder / "scans.csv").open() as file:
        scans = list(csv.DictReader(file))
    assert len(scans) >= 2
    assert float(scans[0]["range_333"]) == pytest.approx(0.44, abs=0.01)
    assert float(scans[0]["intensity_333"]) == 240
    found = read_scans(folder)
    assert found.ranges.shape == found.intensities.shape == (len(scans), 667)
    np.testing.assert_allclose(found.ranges[-1], [float(scans[-1][f"range_{k}"]) for k in range(667)])
    ((begin, returns, levels),) = found.summarise([0.0, 0.5, 1.0])
    assert (begin, returns, *levels) == (0.0, np.isfinite(found.ranges).sum(), 240, 240, 240)
    facts = json.loads((folder / "drive.json").read_text())
    assert facts["ended"] == "its time is over"
    assert facts["settings"]["seed"] == 8
    assert facts["latency"]["steps"] == 10
    assert facts["versions"]["numpy"] == np.__version__
    with pytest.raises(TriformError, match="already holds a recording"):
        run(config)


def test_a_full_disk_ends_a_file_with_a_warning_and_whole_lines(tmp_path: Path) -> None:
    warnings: list[str] = []
    path = tmp_path / "log.csv"
    log = CsvLog(path, ("a", "b"), warnings.append)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50, limits[1]))
    try:
        for _ in range(5):
            log.write([1, 0.5])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    log.write([2, 0.5])
    log.close()
    assert path.read_text() == "a,b\n" + 4 * "1,0.500000\n"
    assert len(warnings) == 1
    assert "the robot drives on" in warnings[0]


def test_a_recording_that_cannot_go_on_does_not_stop_the_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise TriformError("no space left")

    monkeypatch.setattr("triform.robots.recorder.write_atomically", full)
    said = run(DriveConfig(controller=SCAN_PIPELINE, duration=0.5, rate=10.0, record=tmp_path / "r"))
    assert len(made[0].commands) == 5
    assert "warning: no space left" in said


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_stops_the_wheels_and_shows_the_budget(
    number: int, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if signal.getsignal(number) == signal.SIG_IGN:
        pytest.skip("this process was started to ignore the signal")
    before, shown = signal.getsignal(number), io.StringIO()
    monkeypatch.setattr(FakeBase, "signal", number)
    with pytest.raises(SystemExit) as ended:
        run(DriveConfig(controller=SCAN_PIPELINE, rate=20.0, record=tmp_path / "r"), shown)
    assert ended.value.code == status
    (base,) = made
    assert (len(base.commands), base.stops) == (5, 1)
    assert "5 commands" in shown.getvalue()
    assert json.loads((tmp_path / "r/drive.json").read_text())["ended"] == str(status)
    assert signal.getsignal(number) is before


def test_what_ended_a_drive_is_recorded_even_if_it_is_an_error_of_the_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stumble(*_: object) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(FakeBase, "odometry", stumble)
    with pytest.raises(ZeroDivisionError):
        run(DriveConfig(controller=SCAN_PIPELINE, record=tmp_path / "r"))
    assert made[0].stops == 1
    assert json.loads((tmp_path / "r/drive.json").read_text())["ended"] == "a bug"


@pytest.mark.parametrize("terminal", [False, True])
def test_a_robot_drives_on_and_records_where_nothing_can_be_shown(tmp_path: Path, terminal: bool) -> None:
    """As on a full disk, and at a terminal that has been closed."""
    config = DriveConfig(controller=SCAN_PIPELINE, duration=1.5, rate=10.0, record=tmp_path / "r")
    with Path("/dev/full").open("w") as full:
        run_drive(config, screen_of(config, Console(file=full, width=200, force_terminal=terminal)))
    assert len(made[0].commands) == 15
    assert json.loads((tmp_path / "r/drive.json").read_text())["ended"] == "its time is over"


def test_names_of_files_are_shown_as_they_are(tmp_path: Path) -> None:
    folder = tmp_path / "[red]run[/red]"
    assert f"recorded in {folder}" in run(DriveConfig(controller=SCAN_PIPELINE, duration=0.5, rate=10.0, record=folder))


def test_nohup_holds() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopSignals() as signals:
            os.kill(os.getpid(), signal.SIGHUP)
            signals.check()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_lost_lidar_stops_the_wheels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeLidar, "lost_after", 1.0)
    with pytest.raises(TriformError, match="the LiDAR is lost"):
        run(DriveConfig(controller=SCAN_PIPELINE, rate=20.0))
    assert made[0].stops == 1


def test_a_lost_base_says_so_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeBase, "lost", True)
    with pytest.raises(TriformError, match="the base is lost"):
        run(DriveConfig(controller=SCAN_PIPELINE, rate=20.0))
    assert made[0].stops == 1


def test_a_lidar_that_falls_silent_leaves_the_robot_standing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeLidar, "silent_after", 0.5)
    said = run(DriveConfig(controller=SCAN_PIPELINE, rate=20.0, duration=2.0))
    np.testing.assert_array_equal(made[0].commands[-5:], np.zeros((5, 3)))
    assert said.count("the robot stands still until one comes") == 1
    assert "no fresh scan" in said


@pytest.mark.parametrize("name", ["expert", "triangulating", "gnn"])
def test_controllers_that_see_poses_are_refused(name: str) -> None:
    with pytest.raises(TriformError, match="no real robot knows"):
        run(DriveConfig(controller=ControllerSpec(name)))
    assert made == []


@pytest.mark.parametrize(
    "setting",
    [
        {"distance": 0.0},
        {"distance": 4.5},
        {"rate": np.nan},
        {"rate": 2.0},
        {"watchdog": np.inf},
        {"max_speed": 0.0},
        {"max_turn_rate": np.inf},
        {"duration": 0.1},
        {"usb": True, "address": "10.0.0.1"},
        {"robot": -1},
        {"seed": -1},
        {"start_pose": (0.0, np.nan, 0.0)},
        {"mounting": np.inf},
        {"lidar_position": (0.0, np.nan)},
        {"blind_sector": ("10-20",)},
        {"blind_sector": ("0:180", "180:360")},
        {"blind_sector": ("90:450",)},
        {"footprint": "box:0.3x-0.2"},
    ],
)
def test_bad_settings_are_refused(setting: dict[str, object]) -> None:
    with pytest.raises(ConfigurationError):
        DriveConfig(**setting)  # type: ignore[arg-type]


def test_the_mounting_is_the_profiles_and_the_options_replace_it(tmp_path: Path) -> None:
    mounting = Mounting(0.1, -0.05, 1.0, upright=False, blind_sectors=((170.0, 190.0),))
    file = tmp_path / "mine.toml"
    file.write_text(profile_toml(replace(HARDWARE, mounting=mounting)), encoding="utf-8")
    assert DriveConfig(profile=str(file)).mounted == mounting
    changed = DriveConfig(
        profile=str(file), mounting=0.5, lidar_position=(0.0, 0.0), blind_sector=("350:10", "-95:-85")
    )
    sectors = ((170.0, 190.0), (350.0, 10.0), (-95.0, -85.0))
    assert changed.mounted == Mounting(0.0, 0.0, 0.5, upright=False, blind_sectors=sectors)
    assert DriveConfig(upside_down=True).mounted == Mounting(upright=False)


def test_where_the_base_is() -> None:
    assert DriveConfig().base_address == "192.168.2.1"
    assert DriveConfig(usb=True).base_address == "192.168.42.2"
    assert DriveConfig(address="10.0.0.1").base_address == "10.0.0.1"


def test_a_guard_that_is_not_wanted_is_left_out() -> None:
    said = [DriveConfig(guard=guard).make_controller(lambda: None).description for guard in (True, False)]
    assert ["guard" in each for each in said] == [True, False]


def test_the_line_tells_the_rate_from_the_first_second_on_and_no_negative_zero() -> None:
    config = ScanConfig(rays=8)
    view = View(Scan(np.ones((1, 1, 8)), config), np.ones((1, 1), bool), 0.0)
    shown = io.StringIO()
    line = StatusLine(Screen(Console(file=shown, width=200)), (0.3, 0.2), dry_run=False)
    command = np.array([0.1, -0.001, -1e-9])
    for k in range(9):
        sent = 100 + k / 8
        line.show(Step(sent - 0.02, sent - 0.01, sent, None, view, command, None, blind=True, late=False))
    assert shown.getvalue() == "0.0 s, 8.0 Hz, no scan yet, sent +0.10 +0.00 m/s +0.00 rad/s\n"


def test_scans_that_no_command_used_are_missed() -> None:
    """Turns of 0.1 s, of which every third is seen twice."""
    config = ScanConfig(rays=8)
    view = View(Scan(np.ones((1, 1, 8)), config), np.ones((1, 1), bool), 0.0)
    budget = Budget()
    for k in range(6):
        turn = Turn(np.ones(8), 0.3 * (k // 2), 0.3 * (k // 2) + 0.1)
        budget.add(Step(1.0 + k, 1.01 + k, 1.02 + k, turn, view, np.zeros(3), None, blind=False, late=k == 4))
    found = budget.summary()
    assert (found["scans_used"], found["scans_missed"]) == (3, 4)
    assert (found["steps"], found["late_ticks"], found["blind_steps"]) == (6, 1, 0)
    assert found["seconds"]["send"]["max"] == pytest.approx(0.01)
    assert "map" not in found["seconds"]


@given(
    st.lists(st.floats(1e-5, 100.0), min_size=1, max_size=50),
    st.sampled_from([1, 7, 1000]),
)
def test_durations_have_the_quantiles_of_numpy(seconds: list[float], times: int) -> None:
    durations = Durations()
    for _ in range(times):
        for each in seconds:
            durations.add(each)
    found = durations.summary()
    everything = np.repeat(seconds, times)
    for name, share in (("median", 0.5), ("p95", 0.95)):
        low, high = (np.quantile(everything, share, method=method) for method in ("inverted_cdf", "higher"))
        assert low * 0.998 <= found[name] <= high * 1.002
    assert found["max"] == max(seconds)
    assert found["median"] <= found["p95"] <= found["max"]


def test_a_long_drive_needs_no_more_memory_than_a_short_one() -> None:
    config = ScanConfig(rays=8)
    view = View(Scan(np.ones((1, 1, 8)), config), np.ones((1, 1), bool), 0.0)
    budget = Budget()

    def steps(count: int) -> None:
        for k in range(count):
            turn = Turn(np.ones(8), 0.1 * k, 0.1 * k + 0.1)
            budget.add(Step(1.0, 1.01, 1.02 + k * 1e-6, turn, view, np.zeros(3), None, blind=False, late=False))

    steps(100)
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        steps(10_000)
        assert tracemalloc.get_traced_memory()[0] - before < 20_000
    finally:
        tracemalloc.stop()
    assert budget.summary()["steps"] == 10_100
