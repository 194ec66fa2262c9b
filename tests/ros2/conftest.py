"""Executables of the ROS 2 package in processes of their own, and a node that talks to them over real DDS."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

PACKAGE = Path(__file__).parents[2] / "ros2" / "triform_ros"
#: What takes the place of packages that have no wheels.
STAND_INS = Path(__file__).parent / "stand_ins"
#: A loaded machine may take this long for anything [s].
PATIENCE = 60.0


def free_domain() -> int:
    """A domain of which no port is in use: each has 250 UDP ports from 7400 on."""
    used = {
        int(line.split()[1].rpartition(":")[2], 16)
        for table in ("/proc/net/udp", "/proc/net/udp6")
        if Path(table).exists()
        for line in Path(table).read_text().splitlines()[1:]
    }
    free = [each for each in range(1, 101) if used.isdisjoint(range(7400 + 250 * each, 7650 + 250 * each))]
    return random.SystemRandom().choice(free)


class Executable:
    """One executable of the package in a process of its own."""

    def __init__(self, name: str, environment: dict[str, str], log: Path, arguments: list[str]) -> None:
        self._log = log
        with log.open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", f"triform_ros.{name}", "--ros-args", *arguments],
                env=environment, stdout=output, stderr=subprocess.STDOUT,
            )  # fmt: skip

    @property
    def log(self) -> str:
        return self._log.read_text()

    def wait(self) -> int:
        try:
            return self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            pytest.fail(f"it has not ended: {self.log}")

    def end(self, number: signal.Signals) -> int:
        self.process.send_signal(number)
        return self.wait()


class Ros:
    """A node in a domain of its own, and the processes beside it."""

    def __init__(self, folder: Path) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        # The parser of message types that comes with ROS uses a module of Python that is deprecated.
        with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
            import rosidl_generator_py  # noqa: F401
        domain = free_domain()
        self._folder = folder
        self._processes: list[Executable] = []
        self._environment = os.environ | {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_LOG_DIR": str(folder),
            "PYTHONPATH": os.pathsep.join([str(PACKAGE), os.environ.get("PYTHONPATH", "")]),
        }
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("test", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)

    def start(self, name: str, *arguments: str, namespace: str = "", **parameters: Any) -> Executable:
        """Start an executable with parameters."""
        given = [word for key, value in parameters.items() for word in ("-p", f"{key}:={_yaml(value)}")]
        place = ["-r", f"__ns:=/{namespace}"] if namespace else []
        log = self._folder / f"{name}-{len(self._processes)}.log"
        self._processes.append(Executable(name, self._environment, log, [*place, *given, *arguments]))
        return self._processes[-1]

    def add_transforms(self) -> None:
        """Give this process, and those started from now on, messages of transforms."""
        found = find_spec("tf2_msgs")
        if found is None or str(STAND_INS) in str(found.origin):
            sys.path.append(str(STAND_INS))
            self._environment["PYTHONPATH"] += os.pathsep + str(STAND_INS)

    def until(self, done: Callable[[], bool], what: str, patience: float = PATIENCE) -> None:
        """Listen until ``done``."""
        deadline = time.monotonic() + patience
        while not done():
            if time.monotonic() > deadline:
                pytest.fail(f"{what} took too long: {[each.log for each in self._processes]}")
            self._executor.spin_once(timeout_sec=0.02)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service and return what it answers."""
        client = self.node.create_client(kind, name)
        self.until(client.service_is_ready, f"the service {name}")
        answer = client.call_async(request)
        self.until(answer.done, f"the answer of {name}")
        return answer.result()

    def listen(self, duration: float) -> None:
        """Listen for a while [s]."""
        end = time.monotonic() + duration
        self.until(lambda: time.monotonic() > end, "a pause")

    def close(self) -> None:
        for each in self._processes:
            if each.process.poll() is None:
                each.process.kill()
            each.process.wait()
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


def _yaml(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


@pytest.fixture
def ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    """A domain of one's own; skips where there is no ROS, unless ``TRIFORM_REQUIRE_ROS`` is set."""
    if find_spec("rclpy") is None:
        if os.environ.get("TRIFORM_REQUIRE_ROS"):
            pytest.fail("rclpy is missing, and TRIFORM_REQUIRE_ROS is set; the extra ros has it")
        pytest.skip("rclpy is missing; the extra ros has it")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    monkeypatch.setattr(sys, "path", [*sys.path, str(PACKAGE)])
    talker = Ros(tmp_path)
    yield talker
    talker.close()
