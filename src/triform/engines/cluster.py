"""The Ray engine: processes of this machine or of a whole cluster. Only this room imports Ray.

No file system is shared: tasks, items and results travel as bytes.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import ipaddress
import math
import os
import socket
import time
from collections.abc import Callable, Generator, Sequence
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import Any

import ray
from ray import cloudpickle

from triform.engines.identity import differences, identity
from triform.engines.interface import Item, Report, Result, Task
from triform.engines.patience import SERVERS, Patience
from triform.engines.progress import Noticeboard, reporter
from triform.engines.surroundings import on_loopback, silence
from triform.threads import limit_threads, usable_threads
from triform.types import TriformError, require

#: How often an item is begun again because its worker or its machine died.
_RETRIES = 10
#: How long a cluster may take to answer at all [s].
_PATIENCE = 5.0
#: Time between two counts of a cluster's processors [s].
_COUNTING = 10.0
#: How long Ray may take to let go [s].
_FAREWELL = 3.0
#: Room for results that wait to be taken [bytes]: of a Ray instance of our own, and for each of its workers.
_STORE, _STORE_PER_WORKER = 128 * 2**20, 32 * 2**20


class RayEngine:
    """Works in Ray's workers, one processor for each item; an item whose worker dies is begun again elsewhere."""

    def __init__(self, threads: int | None = None, address: str | None = None) -> None:
        """Connect to a cluster, or start Ray on this machine alone.

        Args:
            threads: Items worked on at once; all processors of this machine or of the cluster if ``None``.
            address: ``host:port`` of a cluster's head, or ``auto`` for the one that this machine belongs to; if
                ``None``, Ray is started here and shut down by ``close``.

        Raises:
            TriformError: If Ray cannot be reached or started.
            ConfigurationError: If a setting is not allowed.
        """
        require(threads is None or threads >= 1, f"{threads} workers asked for; at least 1 is needed")
        #: Most items that are with Ray at once; if ``None``, twice as many as there are workers.
        self._at_once = threads if address is not None else None
        self._workers, self._counted = threads or usable_threads(), math.inf if address is None else -math.inf
        self._board: Noticeboard | None = None
        self._ask = Patience()
        self._keys = count()
        quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "critical"}
        try:
            if address is None:
                store = _STORE + self._workers * _STORE_PER_WORKER
                quiet |= {"num_cpus": self._workers, "num_gpus": 0, "object_store_memory": store}
                with on_loopback(), silence():
                    self._ask(partial(ray.init, "local", include_dashboard=False, **quiet))
                require(
                    ipaddress.ip_address(ray.util.get_node_ip_address()).is_loopback,
                    "this version of Ray cannot be kept to this machine alone; start Ray yourself and give ray_address",
                )
            else:
                address = _resolved(address)
                if address != "auto":
                    _check_address(address)
                with silence():
                    self._ask(partial(ray.init, address, **quiet))
            self._ask.watch(self._ask(_servers))
        except TriformError:
            self.close()
            raise
        except Exception as error:  # Ray raises anything, plain exceptions too.
            self.close()
            if address is None:
                raise TriformError(f"cannot start Ray on this machine: {_first_line(error)}") from error
            if address == "auto" and isinstance(error, ConnectionError):
                raise TriformError("no Ray cluster runs on this machine; give its head's host:port") from error
            raise TriformError(
                f"cannot use Ray at {address}: {_first_line(error)} (a cluster that asks for a token needs "
                "RAY_AUTH_MODE=token here as on its nodes)"
            ) from error

    def close(self) -> None:
        """Let go of the cluster, or stop the Ray that was started here."""
        self._ask.farewell()
        # Without its servers a shutdown may end this process before it has said why.
        if self._ask.lost or not self._ask.give_up(ray.shutdown, _FAREWELL):
            # At the end of the process it would be waited for again, and its threads would crash it.
            atexit.unregister(ray.shutdown)
            _leave_out_destructors()

    def run(
        self, task: Task[Item, Result], items: Sequence[Item], on_progress: Report | None = None
    ) -> Generator[tuple[int, Result], None, None]:
        """As ``Engine.run``; progress is noted about once a second, and ``close`` stops items under way.

        They are not cancelled one by one, because ``ray.cancel`` on an item that is just being finished can abort
        this process (Ray 2.60: "Tried to complete task that was not pending").

        Raises:
            TriformError: What the task raised, in one sentence; or a machine of the cluster would give other results.
        """
        remote = ray.remote(_by_value()).options(num_cpus=1, max_retries=_RETRIES, retry_exceptions=False)
        ask, whole, here = self._ask, cloudpickle.dumps(task), identity()
        pickled = ask(lambda: ray.put(whole))
        board = ask(self._noticeboard) if on_progress is not None else None
        actor = board.actor if board is not None else None
        waiting = iter(enumerate(items))
        running: dict[Any, tuple[int, int]] = {}
        shown: dict[int, float] = {}

        def show(key: int, amount: float) -> None:
            # What an item that is done again reports was shown before.
            more = amount - shown.get(key, 0.0)
            if on_progress is not None and more > 0.0:
                shown[key] = amount
                on_progress(more)

        while True:
            for index, item in islice(waiting, max(0, ask(self._most) - len(running))):
                key = next(self._keys)
                given = pickled, cloudpickle.dumps(item), here, actor, key
                running[ask(partial(remote.remote, *given))] = index, key
            if not running:
                return
            finished, _ = ask(partial(ray.wait, list(running), timeout=1.0))
            for reference in finished:
                result, reported = ask(partial(_outcome, reference))
                index, key = running.pop(reference)
                show(key, reported)
                yield index, result
            if board is not None:
                under_way = {key for _, key in running.values()}
                for key, amount in ask(board.read).items():
                    if key in under_way:
                        show(key, amount)

    def _noticeboard(self) -> Noticeboard:
        if self._board is None:
            self._board = Noticeboard()
        return self._board

    def _most(self) -> int:
        """Items that may be with Ray now: enough that no worker waits, few enough for any memory."""
        now = time.monotonic()
        if self._at_once is None and now - self._counted > _COUNTING:
            # Machines join and leave a cluster.
            self._workers, self._counted = max(1, int(ray.cluster_resources().get("CPU", 0))), now
        return self._at_once or 2 * self._workers


def _leave_out_destructors() -> None:
    """Let this process end with its own status, but without destructors, where the system can (glibc's ``on_exit``)."""
    system = ctypes.CDLL(None)
    if hasattr(system, "on_exit"):
        system.on_exit(ctypes.cast(system._exit, ctypes.c_void_p), None)


def carry_out(task: bytes, item: bytes, driver: dict[str, str], board: Any, key: int) -> tuple[bytes, float]:
    """Do one item on a worker.

    Args:
        task: The pickled task.
        item: The pickled item.
        driver: ``identity`` of the machine that will use the result.
        board: Actor of the noticeboard for reports; ``None`` if nobody reads them.
        key: Of this item on it.

    Returns:
        The pickled result, or the pickled ``TriformError`` that the task raised or that this machine is refused with;
        and the sum of what the task reported.
    """
    unlike = differences(driver, identity())
    if unlike:
        # Checked before unpickling, which other versions might not survive.
        return cloudpickle.dumps(foreign(unlike)), 0.0
    report, total = reporter(board, key)
    try:
        with limit_threads(1):
            result = _unpickled(task)(cloudpickle.loads(item), report)
    except TriformError as error:
        return cloudpickle.dumps(error), 0.0
    return cloudpickle.dumps(result), total()


def foreign(unlike: str) -> TriformError:
    """Say that this worker's machine cannot be used."""
    return TriformError(
        f"the Ray node {ray.util.get_node_ip_address()} has {unlike}; its results would not be identical, so give "
        "every node the same"
    )


@functools.lru_cache(maxsize=1)
def _unpickled(task: bytes) -> Task[Any, Any]:
    """The task, which may hold a whole policy, unpickled once for all items of a worker."""
    unpickled: Task[Any, Any] = cloudpickle.loads(task)
    return unpickled


def _by_value() -> Callable[[bytes, bytes, dict[str, str], Any, int], tuple[bytes, float]]:
    """The function that Ray sends to workers: a local one, which goes there whole, whatever they have installed."""

    def triform_item(task: bytes, item: bytes, driver: dict[str, str], board: Any, key: int) -> tuple[bytes, float]:
        try:
            from triform.engines.cluster import carry_out
        except ImportError as error:
            message = f"a Ray node cannot import triform ({error}); install it on every node, with the extra ray"
            raise RuntimeError(message) from None
        return carry_out(task, item, driver, board, key)

    return triform_item


def _outcome(reference: Any) -> tuple[Any, float]:
    """Result of a finished item, and what it reported.

    Raises:
        TriformError: If there is none.
    """
    try:
        pickled, reported = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        cause = error.cause
        raise TriformError(f"a task failed on a Ray worker: {type(cause).__name__}: {_first_line(cause)}") from error
    except ray.exceptions.RayError as error:
        raise TriformError(
            f"a task was given up after {_RETRIES} retries or cannot be run: {_first_line(error)}"
        ) from error
    result = cloudpickle.loads(pickled)
    if isinstance(result, TriformError):
        raise result
    return result, reported


def _servers() -> dict[str, tuple[str, int]]:
    """Where the servers listen that this process is connected to: the cluster's head and this machine's own node."""
    here = ray.get_runtime_context()
    host, _, port = here.gcs_address.rpartition(":")
    found = {SERVERS["gcs_server"]: (host.strip("[]"), int(port))}
    for node in ray.nodes():
        if node["NodeID"] == here.get_node_id():
            found[SERVERS["raylet"]] = node["NodeManagerAddress"], node["NodeManagerPort"]
    return found


def _resolved(address: str) -> str:
    """The ``host:port`` that Ray takes ``auto`` for, or ``auto`` if only Ray can find one."""
    if address != "auto":
        return address
    given = os.environ.get("RAY_ADDRESS") or "auto"
    if given != "auto":
        return given
    # ``ray start`` notes its head there (ray._private.utils.read_ray_address).
    temporary = os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or "/tmp"  # noqa: S108
    note = Path(temporary, "ray", "ray_current_cluster")
    try:
        return note.read_text().strip() or "auto"
    except OSError:
        return "auto"


def _check_address(address: str) -> None:
    """Make sure that a server like Ray's answers there, because Ray itself would try for minutes.

    Raises:
        ConfigurationError: If it is no address.
        OSError: If nothing answers.
    """
    host, _, port = address.rpartition(":")
    require(
        host != "" and port.isdecimal() and 0 < int(port) < 2**16,
        f"ray_address is {address!r}; host:port or auto is needed",
    )
    with socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE) as server:
        if os.environ.get("RAY_USE_TLS", "0") != "0":
            return
        # Ray speaks gRPC, that is HTTP/2 (RFC 9113, 3.4): both sides begin with their settings, a frame of type 4.
        server.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0]))
        with server.makefile("rb") as answer:
            if answer.read(9)[3:4] != b"\x04":
                raise OSError("what answers there is not Ray")


def _first_line(error: BaseException) -> str:
    if isinstance(error, TimeoutError):
        return f"no answer within {_PATIENCE:g} s"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
