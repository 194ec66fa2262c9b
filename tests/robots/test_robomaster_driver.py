from __future__ import annotations

import math
import os
import signal
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from triform.robots.robomaster import RoboMaster, RoboMasterEmulator, RoboMasterError
from triform.types import ConfigurationError, TriformError

#: An address of this machine that no other test process uses.
ADDRESS = f"127.77.{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"
PATIENT = {"watchdog": 20.0}


@pytest.fixture
def emulator():
    with RoboMasterEmulator(ADDRESS, control_port=0) as robot:
        yield robot


def connect(emulator, **options):
    return RoboMaster(emulator.address, ADDRESS, control_port=emulator.control_port, **{**PATIENT, **options})


def until(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.005)


def until_driven(emulator, twist, tolerance=1e-9):
    until(lambda: np.abs(emulator.command - twist).max() <= tolerance)


def keep_driving(base, seconds=20.0):
    """Drive on until an error comes."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        base.drive(np.array([0.1, 0.0, 0.0]))
        time.sleep(0.02)


def test_a_driver_connects_drives_stops_and_leaves(emulator):
    emulator.battery = 73
    with connect(emulator) as base:
        assert emulator.driven
        assert emulator.mode == "free"
        assert base.battery == 73
        base.drive(np.array([0.1, -0.05, 0.0]))
        until_driven(emulator, [0.1, -0.05, 0.0])
        base.stop()
        until_driven(emulator, 0.0)
        base.drive(np.array([0.0, 0.0, 0.5]))
        until(lambda: emulator.command[2] > 0.49)
    until(lambda: not emulator.driven)
    assert not emulator.command.any()
    with pytest.raises(RoboMasterError, match="is closed"):
        base.drive(np.zeros(3))
    base.close()


def test_one_driver_after_the_other_but_no_two_at_once(emulator):
    with connect(emulator):
        with pytest.raises(RoboMasterError, match="telemetry"):
            connect(emulator)
        with pytest.raises(RoboMasterError, match=r"closed the connection|does not answer"):
            connect(emulator, push_port=0)
        assert emulator.driven
    until(lambda: not emulator.driven)
    with connect(emulator) as base:
        base.drive(np.array([0.1, 0.0, 0.0]))
        until_driven(emulator, [0.1, 0.0, 0.0])


def test_twists_arrive_to_their_decimals(emulator):
    with connect(emulator, max_speed=3.5, max_turn_rate=10.4) as base:
        speeds = st.floats(-3.5, 3.5)

        @settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow])
        @given(speeds, speeds, st.floats(-10.4, 10.4))
        def arrive(u_x, u_y, omega):
            base.drive(np.array([u_x, u_y, omega]))
            until_driven(emulator, [u_x, u_y, omega], 0.0005 + 1e-9)

        arrive()


def test_fast_commands_are_clipped(emulator):
    with connect(emulator, max_speed=0.2, max_turn_rate=0.5) as base:
        base.drive(np.array([9.0, -9.0, 9.0]))
        until_driven(emulator, [0.2, -0.2, 0.5], 1e-4)


@pytest.mark.parametrize("command", [[math.nan, 0.0, 0.0], [0.0, math.inf, 0.0], [0.1, 0.0]])
def test_what_is_no_command_stops_the_wheels(emulator, command):
    with connect(emulator) as base:
        base.drive(np.array([0.1, 0.0, 0.0]))
        until_driven(emulator, [0.1, 0.0, 0.0])
        with pytest.raises(RoboMasterError, match="three finite numbers"):
            base.drive(np.array(command))
        until_driven(emulator, 0.0)
        base.drive(np.array([0.1, 0.0, 0.0]))
        until_driven(emulator, [0.1, 0.0, 0.0])


def test_wheels_stop_when_no_command_comes_and_go_on_with_the_next(emulator):
    with connect(emulator, watchdog=1.0) as base:
        base.drive(np.array([0.1, 0.0, 0.0]))
        until_driven(emulator, [0.1, 0.0, 0.0])
        until_driven(emulator, 0.0)
        assert emulator.driven
        base.drive(np.array([0.0, 0.1, 0.0]))
        until_driven(emulator, [0.0, 0.1, 0.0])


def told(base, pose):
    found = base.odometry(time.monotonic())
    return found is not None and np.abs(found - pose).max() < 1e-3


def test_odometry_follows_the_robot(emulator):
    with connect(emulator) as base:
        for pose in ([0.0, 0.0, 0.0], [0.3, -0.2, 3.1], [0.3, -0.2, -3.1]):
            emulator.tell(np.array(pose), np.zeros(3))
            until(lambda pose=pose: told(base, pose))
        assert base.odometry(time.monotonic() - 1000) is None
        emulator.hang_up()
        until(lambda: base.odometry(time.monotonic()) is None)


def test_telemetry_goes_on_between_what_it_is_told(emulator):
    start = np.array([1.0, 2.0, math.pi / 2])
    emulator.tell(start, np.zeros(3))
    with connect(emulator) as base:
        until(lambda: told(base, start))
        emulator.tell(start, np.array([0.5, 0.0, 0.0]))
        until(lambda: told(base, [1.0, 2.1, math.pi / 2]))


def test_a_leap_of_the_odometry_is_unknown_until_the_robot_says_it_again(emulator):
    with connect(emulator) as base:
        emulator.tell(np.zeros(3), np.zeros(3))
        until(lambda: told(base, np.zeros(3)))
        emulator.tell(np.array([1000.0, 0.0, 0.0]), np.zeros(3))
        believed = []
        while not believed or believed[-1] < 999:
            pose = base.odometry(time.monotonic())
            believed += [] if pose is None else [pose[0]]
        # Nothing between the two places, and nothing ahead of the leap, was ever known.
        assert all(abs(place) < 1e-3 or abs(place - 1000) < 1e-3 for place in believed)
        until(lambda: told(base, [1000.0, 0.0, 0.0]))
        emulator.tell(np.array([1e300, np.nan, 0.0]), np.zeros(3))
        until(lambda: base.odometry(time.monotonic()) is None)


def test_answers_may_come_in_any_pieces(emulator):
    emulator.pieces = True
    with connect(emulator) as base:
        assert base.battery == 100
        for _ in range(20):
            base.drive(np.array([0.1, 0.0, 0.0]))
            time.sleep(0.01)
        until_driven(emulator, [0.1, 0.0, 0.0])
        base.stop()


def test_old_firmware_ends_its_answers_with_nothing(emulator, monkeypatch):
    monkeypatch.setattr("triform.robots.robomaster.driver._PAUSE", 0.1)
    emulator.end = ""
    with connect(emulator) as base:
        assert base.battery == 100
        for _ in range(20):
            base.drive(np.array([0.1, 0.0, 0.0]))
            time.sleep(0.01)
        until_driven(emulator, [0.1, 0.0, 0.0])
        emulator.error = "fail"
        with pytest.raises(RoboMasterError, match='it says "fail'):
            keep_driving(base)


def test_what_a_robot_says_never_steers_the_terminal(emulator):
    emulator.error = "\x1b[2J\x1b]0;owned\x07 \x9b31m"
    with pytest.raises(RoboMasterError, match="does not enter SDK mode") as caught:
        connect(emulator)
    assert str(caught.value).isprintable()
    emulator.error = ""
    until(lambda: emulator._driver is None)
    with connect(emulator) as base:
        emulator.error = "\x1b[31mfail\x1b[0m"
        with pytest.raises(RoboMasterError, match="fail") as caught:
            keep_driving(base)
    assert str(caught.value).isprintable()


def test_an_error_of_the_robot_is_raised_at_a_next_call_and_stays(emulator):
    with connect(emulator) as base:
        base.drive(np.array([0.1, 0.0, 0.0]))
        until_driven(emulator, [0.1, 0.0, 0.0])
        emulator.error = "fail"
        with pytest.raises(RoboMasterError, match='lost: it says "fail"'):
            keep_driving(base)
        with pytest.raises(RoboMasterError, match="fail"):
            base.stop()
        until_driven(emulator, 0.0)


def test_a_robot_that_falls_silent_is_given_up_and_stopped(emulator):
    with connect(emulator, watchdog=0.3) as base:
        base.drive(np.array([0.1, 0.0, 0.0]))
        until_driven(emulator, [0.1, 0.0, 0.0])
        emulator.silent = True
        with pytest.raises(RoboMasterError, match="answered"):
            keep_driving(base)
        until(lambda: not emulator.driven)
        assert not emulator.command.any()


def test_a_late_answer_counts_even_if_it_came_before_the_next_call(emulator):
    with connect(emulator, watchdog=0.3) as base:
        emulator.reply_delay = 0.5
        base.drive(np.array([0.1, 0.0, 0.0]))
        time.sleep(1.0)
        with pytest.raises(RoboMasterError, match=r"answered after 0\.\d|has not answered"):
            base.drive(np.array([0.1, 0.0, 0.0]))


def test_a_lost_connection_is_told(emulator):
    with connect(emulator) as base:
        base.drive(np.array([0.1, 0.0, 0.0]))
        until_driven(emulator, [0.1, 0.0, 0.0])
        emulator.hang_up()
        with pytest.raises(RoboMasterError, match="closed the connection"):
            keep_driving(base)
        assert not emulator.command.any()


@pytest.mark.parametrize("ended", [signal.SIGTERM, signal.SIGKILL])
def test_an_ended_keeper_stops_the_wheels_and_is_told(emulator, ended):
    with connect(emulator) as base:
        base.drive(np.array([0.1, 0.0, 0.0]))
        until_driven(emulator, [0.1, 0.0, 0.0])
        base._process.send_signal(ended)
        until_driven(emulator, 0.0)
        with pytest.raises(RoboMasterError, match="has ended"):
            keep_driving(base)


def test_a_stopped_keeper_is_noticed(emulator):
    with connect(emulator, watchdog=0.3) as base:
        base._process.send_signal(signal.SIGSTOP)
        with pytest.raises(RoboMasterError, match="answered"):
            keep_driving(base)
        base._process.send_signal(signal.SIGCONT)
        until(lambda: not emulator.driven)


def test_drive_never_waits_for_the_robot(emulator):
    with connect(emulator) as base:
        emulator.reply_delay = 3.0
        started = time.monotonic()
        for _ in range(5):
            base.drive(np.array([0.1, 0.0, 0.0]))
        assert time.monotonic() - started < 3.0


@pytest.mark.parametrize("fault", [{"error": "fail"}, {"silent": True}])
def test_a_robot_that_does_not_let_one_in_is_refused_in_a_sentence(emulator, monkeypatch, fault):
    monkeypatch.setattr("triform.robots.robomaster.driver._PATIENCE", 0.5)
    for name, value in fault.items():
        setattr(emulator, name, value)
    with pytest.raises(RoboMasterError, match=r"(does not enter SDK mode|does not answer)") as caught:
        connect(emulator)
    assert "\n" not in str(caught.value)


def test_nobody_there_is_said_in_a_sentence():
    with pytest.raises(RoboMasterError, match=f"cannot reach the RoboMaster at {ADDRESS}:9"):
        RoboMaster(ADDRESS, ADDRESS, control_port=9)


@pytest.mark.parametrize("options", [{"watchdog": 0.0}, {"max_speed": 4.0}, {"max_turn_rate": math.nan}])
def test_limits_are_checked(options):
    with pytest.raises(ConfigurationError, match=next(iter(options))):
        RoboMaster(ADDRESS, **options)


def test_a_taken_address_cannot_be_emulated(emulator):
    with pytest.raises(TriformError, match="cannot emulate"):
        RoboMasterEmulator(ADDRESS, control_port=emulator.control_port)
