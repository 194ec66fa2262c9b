"""What both executables share: one thread listens, the main thread runs, and a last deed is done however it ends."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Protocol

import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from triform.signals import StopSignals
from triform.types import TriformError


class Runner(Protocol):
    """A node that runs in the main thread."""

    @property
    def node(self) -> Node:
        """Its topics and parameters."""
        ...

    def run(self, check: Callable[[], None]) -> None:
        """Run until an exception ends it; ``check``, called often, raises one when a signal came.

        Raises:
            TriformError: It cannot go on.
        """
        ...

    def stop(self) -> None:
        """Do what has to be done at the end, and say what happened."""
        ...


def run_executable(name: str, make: Callable[[Node], Runner], args: list[str] | None) -> int:
    """Make a node called ``name`` and run it until SIGINT, SIGTERM or an error.

    Returns:
        0 after a signal, 1 after an error, which is told in one sentence.
    """
    try:
        _run(name, make, args)
    except TriformError as error:
        print(f"triform: {error}", file=sys.stderr)
        return 1
    return 0


def _run(name: str, make: Callable[[Node], Runner], args: list[str] | None) -> None:
    """Run until a signal comes.

    Raises:
        TriformError: The arguments cannot be used, or the node cannot go on.
    """
    with _refusing_arguments():
        # Handlers of ROS would shut it down before the last command has been published.
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    executor = SingleThreadedExecutor()
    listening = threading.Thread(target=_listen, args=[executor])
    runner: Runner | None = None
    with StopSignals() as signals, suppress(SystemExit):
        try:
            with _refusing_arguments():
                node = rclpy.create_node(name, automatically_declare_parameters_from_overrides=True)
            runner = make(node)
            executor.add_node(node)
            listening.start()
            runner.run(signals.check)
        finally:
            # Nothing may come before the last deed, whoever presses Ctrl-C again.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            if runner is not None:
                runner.stop()
            executor.shutdown()
            if listening.is_alive():
                listening.join()
            rclpy.try_shutdown()


@contextmanager
def _refusing_arguments() -> Iterator[None]:
    """Say in one sentence what ROS itself does not take: remappings, files of parameters, values that are empty."""
    try:
        yield
    except (RuntimeError, ValueError, NameValidationException) as error:
        reason = str(error).splitlines()[0].removeprefix("failed to initialize rcl: ").split(", at /")[0]
        raise TriformError(f"ROS cannot use the arguments: {reason}") from error


def _listen(executor: SingleThreadedExecutor) -> None:
    with suppress(ExternalShutdownException):
        executor.spin()
