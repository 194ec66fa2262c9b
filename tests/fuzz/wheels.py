"""Campaign: how long the wheels of an emulated RoboMaster still turn after a fault, in a real process and in real time.

    python -m tests.fuzz.wheels --seconds 60 --seed 0
    python -m tests.fuzz.wheels --tries 20              # of every fault

Faults come at random moments of a control loop at 8 Hz. The last non-zero command of the wheels has to end within the
watchdog's time, 0.3 s, of the fault.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Callable

import numpy as np

from triform.robots.robomaster import RoboMaster, RoboMasterEmulator, RoboMasterError

WATCHDOG = 0.3
PERIOD = 0.125
#: A machine that does other things too wakes a process late [s].
SLACK = 0.1


def freeze(base: RoboMaster, _: RoboMasterEmulator, __: threading.Event) -> None:
    """Stop the watchdog process, as a debugger or a machine without memory would."""
    base._process.send_signal(signal.SIGSTOP)


def kill(base: RoboMaster, _: RoboMasterEmulator, __: threading.Event) -> None:
    """End the watchdog process."""
    base._process.kill()


def silence(_: RoboMaster, emulator: RoboMasterEmulator, __: threading.Event) -> None:
    """Let the base obey without an answer."""
    emulator.silent = True


def delay(_: RoboMaster, emulator: RoboMasterEmulator, __: threading.Event) -> None:
    """Let the base answer late."""
    emulator.reply_delay = 1.0


def refuse(_: RoboMaster, emulator: RoboMasterEmulator, __: threading.Event) -> None:
    """Let the base answer with an error."""
    emulator.error = "fail"


def close(base: RoboMaster, _: RoboMasterEmulator, __: threading.Event) -> None:
    """Leave the robot while the watchdog process is frozen."""
    base._process.send_signal(signal.SIGSTOP)
    base.close()


def hang(_: RoboMaster, __: RoboMasterEmulator, ended: threading.Event) -> None:
    """Let the control loop give no command any more."""
    ended.set()


FAULTS: dict[str, Callable[[RoboMaster, RoboMasterEmulator, threading.Event], None]] = {
    "frozen keeper": freeze,
    "killed keeper": kill,
    "hung control loop": hang,
    "silent base": silence,
    "late base": delay,
    "refusing base": refuse,
    "closing with a frozen keeper": close,
}


def wheels_turn_for(fault: str, rng: np.random.Generator, address: str) -> tuple[float, float]:
    """Return how long after a fault the wheels still turned, and how long ``close`` took [s]."""
    with RoboMasterEmulator(address, control_port=0) as emulator:
        base = RoboMaster(address, address, WATCHDOG, control_port=emulator.control_port)
        ended = threading.Event()

        def loop() -> None:
            while not ended.is_set():
                try:
                    base.drive(np.array([0.1, 0.0, 0.0]))
                except RoboMasterError:
                    return
                time.sleep(PERIOD)

        driving = threading.Thread(target=loop)
        driving.start()
        time.sleep(rng.uniform(0.4, 0.6))
        began = last = time.monotonic()
        worker = threading.Thread(target=FAULTS[fault], args=(base, emulator, ended))
        worker.start()
        while time.monotonic() - last < 0.5:
            if emulator.command.any():
                last = time.monotonic()
                if last - began > 10:
                    break
            time.sleep(0.001)
        ended.set()
        driving.join()
        worker.join()
        closing = time.monotonic()
        base.close()
        return last - began, time.monotonic() - closing


def main() -> int:
    """Run the campaign and return the exit status."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--tries", type=int, default=None, help="of every fault, in place of seconds")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    address = f"127.76.{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"
    found: dict[str, list[tuple[float, float]]] = {fault: [] for fault in FAULTS}
    rng = np.random.default_rng(given.seed)
    end, tries = time.monotonic() + given.seconds, 0
    while tries < given.tries if given.tries else time.monotonic() < end:
        for fault, times in found.items():
            times.append(wheels_turn_for(fault, rng, address))
        tries += 1
    for fault, times in found.items():
        turned, closing = np.array(times).T
        print(
            f"{fault}: wheels turn for {np.median(turned):.3f} s (median), {turned.max():.3f} s (worst); "
            f"closing then takes {closing.max():.3f} s at most"
        )
    failed = sum(max(each) > WATCHDOG + SLACK for times in found.values() for each in times)
    print(f"wheels: {tries * len(FAULTS)} tried, {failed} failed")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
