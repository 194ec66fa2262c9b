"""Engines: many independent pieces of work, on the threads of this machine or on a cluster.

Results are the same to the bit whatever the engine and however many workers it has, because every piece is a function
of its item alone and the pieces are cut by the configuration alone.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from triform.engines.interface import Engine, Report, Task
from triform.engines.local import LocalEngine
from triform.types import require

__all__ = ["Engine", "EngineName", "LocalEngine", "Report", "Task", "check_engine", "open_engine"]

EngineName = Literal["local", "ray"]

#: Ray reads these when it is imported: no usage statistics, no lines of its own between ours, and no half a minute of
#: waiting for a head that has died before it could say where it listens, during which no Python runs.
_RAY_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_BACKEND_LOG_LEVEL": "fatal",
    "RAY_gcs_server_port_wait_time_s": "6",
}


def check_engine(name: str, address: str | None) -> None:
    """Refuse settings of an engine that contradict each other.

    Raises:
        ConfigurationError: If there is no such engine, or it has no address.
    """
    require(name in ("local", "ray"), f"there is no engine {name!r}; there are local and ray")
    require(address is None or name == "ray", f"ray_address is {address}, but the engine is {name}; choose ray")


@contextmanager
def open_engine(name: EngineName = "local", threads: int | None = None, address: str | None = None) -> Iterator[Engine]:
    """Give an engine while the block runs.

    Args:
        name: ``local`` for threads of this process, ``ray`` for processes of Ray.
        threads: Pieces of work done side by side; all processors of this machine, or of the cluster, if ``None``.
        address: Of a Ray cluster, ``host:port`` or ``auto``; if ``None``, Ray is started on this machine for the block.

    Raises:
        TriformError: If the cluster cannot be reached.
        ConfigurationError: If a setting is not allowed.
        ModuleNotFoundError: If Ray is not installed.
    """
    check_engine(name, address)
    if name == "local":
        yield LocalEngine(threads)
        return
    for variable, value in _RAY_SETTINGS.items():
        os.environ.setdefault(variable, value)
    from triform.engines.cluster import RayEngine

    engine = RayEngine(threads, address)
    try:
        yield engine
    finally:
        engine.close()
