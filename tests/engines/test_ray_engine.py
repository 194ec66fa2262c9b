"""The Ray engine on a cluster of two nodes of one processor each, which all tests here share."""

from __future__ import annotations

import importlib
import ipaddress
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from tests.fuzz import ray_losses
from tests.options import options
from triform.cli import main
from triform.dataset import CollectionConfig, collect
from triform.engines import LocalEngine, open_engine
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.types import TriformError

SMALL = CollectionConfig(
    robots=5, runs=6, steps=30, placements=150, block_placements=30, shard_runs=1, group_records=13, seed=3
)


@pytest.fixture(scope="module")
def address():
    """A cluster that asks for a token, as Ray advises."""
    before = dict(os.environ)
    os.environ.update(
        RAY_AUTH_MODE="token", RAY_AUTH_TOKEN=os.urandom(32).hex(), RAY_USAGE_STATS_ENABLED="0",
        RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO="0", RAY_DEDUP_LOGS_SKIP_REGEX=".",
    )  # fmt: skip
    cluster = importlib.import_module("ray.cluster_utils").Cluster()
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=1, object_store_memory=128 * 2**20, include_dashboard=False)
        yield cluster.address
    finally:
        cluster.shutdown()
        os.environ.clear()
        os.environ.update(before)


@pytest.fixture
def engine(address):
    with open_engine("ray", address=address) as connected:
        yield connected


def descendants(pid: int) -> list[int]:
    """All processes below ``pid``."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    found = [child for child, parent in parents.items() if parent == pid]
    return found + [each for child in found for each in descendants(child)]


def listening(processes: set[int]) -> set[ipaddress.IPv4Address | ipaddress.IPv6Address]:
    """Addresses on which these processes listen; some on any system where Ray runs."""
    found, sockets = set(), set()
    for pid in processes:
        for link in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                sockets.add(link.readlink().name)
    for table in ("tcp", "tcp6"):
        for line in Path("/proc/net", table).read_text().splitlines()[1:]:
            _, local, _, state, *rest = line.split()
            if state == "0A" and f"socket:[{rest[5]}]" in sockets:
                words = [bytes.fromhex(local[k : k + 8])[::-1] for k in range(0, len(local) - 5, 8)]
                place = ipaddress.ip_address(b"".join(words))
                found.add(getattr(place, "ipv4_mapped", None) or place)
    assert found
    return found


class Deadly:
    """An engine whose first worker to finish an item is killed before it hands the result over."""

    def __init__(self, engine, marker):
        self.engine = engine
        self.marker = marker

    def run(self, task, items, on_progress=None):
        marker = self.marker

        def deadly(item, report):
            result = task(item, report)
            if not marker.exists():
                marker.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            return result

        return self.engine.run(deadly, items, on_progress)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.slow
def test_an_evaluation_is_the_same_to_the_bit_on_one_thread_two_and_ray_whose_worker_is_killed(
    engine, tmp_path, monkeypatch
):
    monkeypatch.setattr("triform.evaluation.runs.ROBOTS_PER_CHUNK", 8)
    config = options(EvaluateConfig, robots=(3, 5, 4), runs=6, duration=6.0, profile="hardware", seed=5)
    on_ray = evaluate(config, engine=Deadly(engine, tmp_path / "killed"))
    assert (tmp_path / "killed").exists()
    assert [result["robots"] for result in on_ray.results] == [3, 5, 4]
    for threads in (1, 2):
        here = evaluate(config, engine=LocalEngine(threads))
        for name, column in here.runs.items():
            np.testing.assert_array_equal(on_ray.runs[name], column, err_msg=name)
            assert on_ray.runs[name].dtype == column.dtype


@pytest.mark.slow
def test_a_data_set_has_the_same_bytes_on_one_thread_two_and_ray_whose_worker_is_killed(engine, tmp_path):
    for threads in (1, 2):
        collect(tmp_path / str(threads), SMALL, engine=LocalEngine(threads))
    collect(tmp_path / "ray", SMALL, engine=Deadly(engine, tmp_path / "killed"))
    assert (tmp_path / "killed").exists()
    assert contents(tmp_path / "ray") == contents(tmp_path / "1") == contents(tmp_path / "2")


@pytest.mark.slow
def test_a_collection_begun_on_ray_is_finished_here(engine, tmp_path):
    def stop(done, total):
        if done > total / 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path / "both", SMALL, progress=stop, engine=engine)
    assert 0 < len(list((tmp_path / "both/shards").iterdir())) < SMALL.shards
    collect(tmp_path / "both", SMALL, engine=LocalEngine(1))
    collect(tmp_path / "here", SMALL, engine=LocalEngine(1))
    assert contents(tmp_path / "both") == contents(tmp_path / "here")


@pytest.mark.slow
def test_commands_take_the_engine_and_the_address(address, tmp_path, capsys):
    ray = ["--engine", "ray", "--ray-address", address]
    tables = []
    for name, extra in (("here", []), ("ray", ray)):
        out = ["--json", str(tmp_path / f"{name}.json"), "--parquet", str(tmp_path / f"{name}.parquet")]
        assert (
            main(
                [
                    "evaluate",
                    "--event",
                    "join",
                    "--runs",
                    "2",
                    "--robots",
                    "3",
                    "--controller",
                    "policy:large",
                    *out,
                    *extra,
                ]
            )
            == 0
        )
        tables.append((tmp_path / f"{name}.parquet").read_bytes())
    assert tables[0] == tables[1]
    reproduce = ["reproduce", "fig4", "--controller", "expert", "--runs", "1", "--duration", "6"]
    assert main([*reproduce, "--output", str(tmp_path / "results"), *ray]) == 0
    assert "ray" not in (tmp_path / "results/index.md").read_text().split("triform reproduce fig4")[1].splitlines()[0]
    assert main(["collect", "--out", str(tmp_path / "data"), "--runs", "1", "--placements", "0", *ray]) == 0
    assert "triform:" not in capsys.readouterr().err
    configurations = [json.loads((tmp_path / f"{name}.json").read_text())["config"] for name in ("here", "ray")]
    assert configurations[0] == configurations[1]


def test_no_more_items_than_threads_are_with_a_cluster(address):
    with open_engine("ray", threads=1, address=address) as engine:
        began = dict(engine.run(lambda item, report: (time.time(), time.sleep(0.1), time.time()), [0, 1, 2]))
    for item in range(2):
        assert began[item][2] <= began[item + 1][0]


def test_progress_shows_while_an_item_is_done_and_not_twice_when_it_is_done_again(engine, tmp_path):
    shown, killed, amounts = tmp_path / "shown", tmp_path / "killed", []

    def work(item, report):
        total = 0
        for _ in range(600):
            report(1)
            total += 1
            if shown.exists():
                break
            time.sleep(0.1)
        if not killed.exists():
            killed.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        report(1000 - total)
        return shown.exists()

    def show(amount):
        amounts.append(amount)
        shown.touch()

    assert dict(engine.run(work, [0], show)) == {0: True}
    assert killed.exists()
    assert 0 < amounts[0] < 1000
    assert min(amounts) > 0
    assert sum(amounts) == 1000


def test_a_lost_noticeboard_changes_no_result(engine):
    def work(item, report):
        time.sleep(1.1)
        report(1)
        return item

    with_progress = engine.run(work, [0, 1, 2], [].append)
    found = dict([next(with_progress)])
    importlib.import_module("ray").kill(engine._board.actor)
    assert found | dict(with_progress) == {0: 0, 1: 1, 2: 2}


@pytest.mark.parametrize("noted", ["variable", "file"])
def test_auto_does_not_wait_for_a_cluster_that_is_gone(noted, tmp_path, capsys, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        gone = f"127.0.0.1:{listener.getsockname()[1]}"
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    monkeypatch.setenv("RAY_ADDRESS", gone if noted == "variable" else "")
    (tmp_path / "ray").mkdir()
    (tmp_path / "ray/ray_current_cluster").write_text(gone if noted == "file" else "")
    out = str(tmp_path / "data")
    assert main(["collect", "--out", out, "--engine", "ray", "--ray-address", "auto"]) == 1
    shown = capsys.readouterr()
    assert shown.err.startswith(f"triform: cannot use Ray at {gone}: connection refused")
    assert len(shown.err.strip().splitlines()) == 1
    assert shown.out == ""


def test_errors_of_a_task_come_back_in_one_sentence(engine):
    def refuse(item, report):
        raise TriformError(f"item {item} is refused")

    def stumble(item, report):
        return 1 / item

    with pytest.raises(TriformError, match=r"^item 7 is refused$"):
        list(engine.run(refuse, [7]))
    with pytest.raises(TriformError, match=r"^a task failed on a Ray worker: ZeroDivisionError: division by zero$"):
        list(engine.run(stumble, [0]))
    assert dict(engine.run(stumble, [1, 2])) == {0: 1.0, 1: 0.5}


def test_a_node_with_other_versions_is_refused_by_name(engine, monkeypatch):
    module = importlib.import_module("triform.engines.cluster")
    here = module.identity()
    monkeypatch.setattr(module, "identity", lambda: here | {"triform": "0.0.9", "numpy": "1.26.4"})
    with pytest.raises(
        TriformError,
        match=rf"^the Ray node \S+ has triform {here['triform']} instead of 0\.0\.9, numpy {here['numpy']} instead of "
        r"1\.26\.4; its results would not be identical",
    ):
        evaluate(options(EvaluateConfig, controller="expert", robots=(3,), runs=1, duration=6.0), engine=engine)


def test_a_worker_that_always_dies_is_given_up(engine, monkeypatch):
    monkeypatch.setattr("triform.engines.cluster._RETRIES", 1)

    def die(item, report):
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(TriformError, match=r"^a task was given up after 1 retries"):
        list(engine.run(die, [0]))


@pytest.mark.parametrize(
    ("server", "says"),
    [("nobody", "connection refused"), ("silent", "no answer within"), ("other", "what answers there is not Ray")],
)
def test_a_wrong_address_is_refused_in_one_sentence(server, says, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("triform.engines.cluster._PATIENCE", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer():
            with listener.accept()[0] as connection:
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        where = f"127.0.0.1:{listener.getsockname()[1]}"
        answering = threading.Thread(target=answer)
        if server == "other":
            answering.start()
        if server == "nobody":
            listener.close()
        assert main(["collect", "--out", str(tmp_path / "data"), "--engine", "ray", "--ray-address", where]) == 1
        if server == "other":
            answering.join()
    shown = capsys.readouterr().err
    assert shown.startswith("triform: cannot use Ray at 127.0.0.1:")
    assert says in shown
    assert len(shown.strip().splitlines()) == 1


@pytest.mark.parametrize("wrong", ["nohost", "host:port", ":6379", "host:99999"])
def test_what_is_no_address_is_refused(wrong):
    with pytest.raises(TriformError, match="host:port or auto is needed"), open_engine("ray", address=wrong):
        pass


def test_a_missing_ray_is_named(tmp_path):
    (tmp_path / "ray").mkdir()
    (tmp_path / "ray/__init__.py").write_text("raise ModuleNotFoundError(\"No module named 'ray'\", name='ray')\n")
    command = [sys.executable, "-m", "triform.cli", "collect", "--out", str(tmp_path / "data"), "--engine", "ray"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1] == (
        "triform: collect needs ray, which the extra 'ray' installs: pip install 'triform[ray]', or in a checkout "
        "pip install '.[ray]'"
    )


@pytest.mark.slow
def test_ctrl_c_ends_a_ray_of_our_own_in_one_sentence(tmp_path):
    out = tmp_path / "data"
    command = [sys.executable, "-m", "triform.cli", "collect", "--out", str(out), "--runs", "4000", "--engine", "ray"]
    token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": os.urandom(32).hex()}
    child = subprocess.Popen(
        [*command, "--workers", "2"], env=os.environ | token, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    while not list(out.glob("shards/shard-*.parquet")):
        assert child.poll() is None, child.communicate()
        time.sleep(0.05)
    ours = descendants(child.pid)
    assert ours
    assert all(each.is_loopback for each in listening({child.pid, *ours}))
    child.send_signal(signal.SIGINT)
    _, errors = child.communicate(timeout=60)
    assert child.returncode == 130
    # Ray itself may add a line about an item that it gives up.
    assert errors.strip().splitlines()[-1].startswith("triform: interrupted")
    assert "Traceback" not in errors
    assert not [pid for pid in ours if Path(f"/proc/{pid}").exists() and _alive(pid)]


@pytest.mark.slow
def test_a_ray_that_is_lost_is_said_in_one_sentence(tmp_path, monkeypatch):
    # On a busy machine it takes longer, but not a minute as Ray itself would.
    monkeypatch.setattr(ray_losses, "LIMIT", 30.0)
    monkeypatch.setattr(ray_losses, "COLLECT", ["collect", "--runs", "120", "--placements", "0"])
    assert ray_losses.lose("gcs_server", "work", signal.SIGKILL, tmp_path) == ""


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
