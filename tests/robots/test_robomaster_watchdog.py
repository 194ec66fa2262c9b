"""Driving processes that really end, in every way there is: the wheels stop, and no process stays behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from triform.robots.robomaster import RoboMasterEmulator

pytestmark = pytest.mark.slow

#: An address of this machine that no other test process uses.
ADDRESS = f"127.78.{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"

DRIVE = """
import os, signal, sys, time
import numpy as np
from triform.robots.robomaster import RoboMaster

what, address, port, watchdog = sys.argv[1:]
if what == "exits on SIGTERM":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
base = RoboMaster(address, address, float(watchdog), control_port=int(port))
if what == "forks" and os.fork() == 0:
    time.sleep(60)
print(os.getpid(), flush=True)

def drive():
    while True:
        base.drive(np.array([0.1, 0.05, 0.2]))
        if what == "hangs" and sys.stdin.readline():
            time.sleep(60)
        if what in ("raises", "exits") and sys.stdin.readline():
            sys.exit(3) if what == "exits" else 1 / 0
        time.sleep(0.02)

if what == "uses no context manager":
    drive()
with base:
    drive()
"""


@pytest.fixture
def emulator():
    with RoboMasterEmulator(ADDRESS, control_port=0) as robot:
        yield robot


@pytest.fixture
def start(emulator):
    """Start a driving process, in a session of its own, and wait until it drives."""
    started = []

    def begin(what, watchdog=20.0):
        arguments = [sys.executable, "-c", DRIVE, what, ADDRESS, str(emulator.control_port), str(watchdog)]
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        process = subprocess.Popen(arguments, start_new_session=True, text=True, **pipes)
        started.append(process)
        assert process.stdout.readline(), process.stderr.read()
        until(lambda: emulator.command.any())
        return process

    yield begin
    for process in started:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def until(condition, seconds=30.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.005)


def watchdog_of(driver):
    """Process id of the watchdog that a driving process has started."""
    for folder in Path("/proc").glob("[0-9]*"):
        if stat(folder.name)[1:2] == [str(driver.pid)] and b"watchdog" in (folder / "cmdline").read_bytes():
            return folder.name
    raise AssertionError("there is no watchdog")


def stat(pid):
    """State and parent of a process; nothing if it has ended."""
    try:
        return (Path("/proc") / pid / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def stopped(emulator, watchdog):
    """Wait until the wheels have stopped, the robot is free and the watchdog has ended."""
    until(lambda: not emulator.command.any())
    until(lambda: not emulator.driven)
    # A process that ended under a parent that does not wait for it is left as a zombie.
    until(lambda: stat(watchdog)[:1] in ([], ["Z"]))


@pytest.mark.parametrize(
    ("what", "ended"),
    [
        ("drives", signal.SIGTERM),
        ("drives", signal.SIGINT),
        ("drives", signal.SIGKILL),
        ("drives", signal.SIGHUP),
        ("exits on SIGTERM", signal.SIGTERM),
        ("uses no context manager", signal.SIGTERM),
        ("uses no context manager", signal.SIGINT),
        ("uses no context manager", signal.SIGKILL),
    ],
)
def test_signals_to_all_processes_of_a_terminal_stop_the_wheels(emulator, start, what, ended):
    driver = start(what)
    watchdog = watchdog_of(driver)
    os.killpg(driver.pid, ended)
    stopped(emulator, watchdog)
    assert driver.wait(30) != 0


@pytest.mark.parametrize("what", ["raises", "exits"])
def test_ends_of_the_driving_process_stop_the_wheels(emulator, start, what):
    driver = start(what)
    watchdog = watchdog_of(driver)
    driver.communicate("now\n", timeout=30)
    stopped(emulator, watchdog)
    assert driver.returncode == (1 if what == "raises" else 3)


def test_a_hung_control_loop_stops_the_wheels(emulator, start):
    driver = start("hangs", 1.5)
    watchdog = watchdog_of(driver)
    driver.stdin.write("now\n")
    driver.stdin.flush()
    until(lambda: not emulator.command.any())
    assert emulator.driven
    driver.kill()
    stopped(emulator, watchdog)


def test_a_stopped_process_stops_the_wheels_until_it_goes_on(emulator, start):
    driver = start("drives", 2.0)
    watchdog = watchdog_of(driver)
    driver.send_signal(signal.SIGSTOP)
    until(lambda: not emulator.command.any())
    assert emulator.driven
    driver.send_signal(signal.SIGCONT)
    until(lambda: emulator.command.any())
    driver.send_signal(signal.SIGSTOP)
    driver.kill()
    stopped(emulator, watchdog)


def test_children_of_a_killed_process_keep_nothing_moving(emulator, start):
    driver = start("forks")
    watchdog = watchdog_of(driver)
    driver.kill()
    stopped(emulator, watchdog)


def test_driver_and_keeper_killed_together_stop_the_wheels(emulator, start):
    driver = start("drives")
    watchdog = watchdog_of(driver)
    os.kill(int(watchdog), signal.SIGKILL)
    driver.kill()
    stopped(emulator, watchdog)


def test_a_lost_connection_ends_all(emulator, start):
    driver = start("drives")
    watchdog = watchdog_of(driver)
    emulator.hang_up()
    stopped(emulator, watchdog)
    assert driver.wait(30) == 1
    assert "closed the connection" in driver.stderr.read()


def test_the_keeper_loads_nothing_but_the_standard_library(emulator, start):
    driver = start("drives")
    maps = (Path("/proc") / watchdog_of(driver) / "maps").read_text()
    assert "site-packages" not in maps
