"""What Ray finds around it when it is started: the addresses that it may use, and where it may write."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ray._private import ray_constants


@contextmanager
def on_loopback() -> Iterator[None]:
    """Let a Ray that is started inside listen on this machine's loopback alone, as it does on Windows and macOS.

    Otherwise all its processes listen on all addresses of the machine.
    """
    variable = ray_constants.ENABLE_RAY_CLUSTERS_ENV_VAR
    before, given = ray_constants.ENABLE_RAY_CLUSTER, os.environ.get(variable)
    # The constant is for this process, and the variable for those that Ray starts.
    ray_constants.ENABLE_RAY_CLUSTER = False
    os.environ[variable] = "0"
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before
        del os.environ[variable]
        if given is not None:
            os.environ[variable] = given


@contextmanager
def silence() -> Iterator[None]:
    """Let nothing that is written to standard error inside be seen: Ray announces there at what level it logs."""
    shown = os.dup(2)
    with Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(shown, 2)
        os.close(shown)
