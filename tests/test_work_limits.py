"""Numbers that no work has are refused, and so is more memory than there is, both before any work."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triform import limits
from triform.cli import main
from triform.experiments.settings import warn_of_time
from triform.limits import check_threads, memory, require_at_most, require_memory
from triform.report.page import read_sections
from triform.types import ConfigurationError, TriformError


@pytest.mark.parametrize(
    "arguments",
    [
        "evaluate --runs 9223372036854775808",
        "evaluate --seed 9223372036854775808",
        "evaluate --robots 1000000000",
        "evaluate --duration 4294967296",
        "evaluate --threads 1000000000",
        "evaluate --latency 9223372036854775808",
        "evaluate --scan-rate 1e9",
        "evaluate --speed-limit 1e300",
        "evaluate --lag 1e300",
        "demo --index 9223372036854775808",
        "compare --large-runs 1000000000",
        "conditions --failures 1000000000",
        "reproduce --runs 1000000000",
        "measure take.csv --threads 1000000000",
        "collect --out data --runs 1000000000",
        "collect --out data --steps 1000000000",
        "collect --out data --placements 1000000000",
        "collect --out data --workers 1000000000",
        "bench --seconds 1e300",
        "bench --rate 1e300",
        "emulate --latency 1e300",
        "emulate --index 9223372036854775808",
        "train --out run --maps 1000000000000000",
        "train --out run --producers 1000000000",
        "train --out run --threads 1000000000",
    ],
)
def test_absurd_numbers_are_wrong_usage(arguments: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments.split())
    assert ended.value.code == 2
    words = arguments.split()
    assert f"{words[-2].strip('-').replace('-', '_')} is " in re.sub(r"[\s│]+", " ", capsys.readouterr().err)


@pytest.mark.parametrize(
    "arguments",
    ["evaluate --robots 3 --duration 1000", "demo --robots 3 --duration 1000", "collect --out data --steps 1000000"],
)
def test_more_memory_than_there_is_is_refused_before_any_work(
    arguments: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(limits, "memory", lambda: 2**20)
    assert main(arguments.split()) == 1
    said = capsys.readouterr().err
    assert "GB of memory, and this machine has 0 GB" in said
    assert len(said.splitlines()) == 1


def test_the_memory_of_this_machine_is_known_and_enough_for_little() -> None:
    found = memory()
    assert found is None or found > 2**28
    require_memory(2**20, "nothing much")
    if found is not None:
        with pytest.raises(ConfigurationError, match="it would need about"):
            require_memory(2.0 * found, "it")


def test_what_is_omitted_is_within_all_limits() -> None:
    check_threads(None)
    require_at_most("runs", None, 1)
    require_at_most("runs", 1, 1)
    for threads, says in ((0, "at least 1"), (10**9, "at most 4,096")):
        with pytest.raises(ConfigurationError, match=says):
            check_threads(threads)


def test_the_threads_of_an_evaluation_share_the_memory(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # One thread holds about 27 MB of these runs.
    monkeypatch.setattr(limits, "memory", lambda: 200_000_000)
    command = ["evaluate", "--controller", "expert", "--robots", "5", "--runs", "500", "--duration", "20", "--threads"]
    assert main([*command, "64"]) == 1
    said = capsys.readouterr().err
    assert said.startswith("triform: the runs of 64 threads at once (option threads) would need about")
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize(("work", "said"), [(1e6, ""), (86400.0 * 5000 * 2 * 10, "about 10 days on 2 threads")])
def test_work_of_days_says_so_before_it_begins(work: float, said: str, listener: Any) -> None:
    warn_of_time(work, 2, listener)
    shown = listener.console.file.getvalue().replace("\n", " ")
    assert said in shown
    assert bool(shown) == bool(said)


@pytest.mark.parametrize("shape", [(10**9, 10**6, 3), (10**9, 0, 0, 3), (10**9, 5), (0, 5)])
@pytest.mark.parametrize("command", ["measure --rate 10", "evaluate --controller expert --starts"])
def test_arrays_that_claim_more_than_they_hold_are_refused_at_once(
    command: str, shape: tuple[int, ...], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
    path = tmp_path / "array.npy"
    path.write_bytes(header.getvalue())
    assert path.stat().st_size == 128
    assert main([*command.split(), str(path)]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"triform: {path} ")
    assert len(said.splitlines()) == 1


def test_json_that_nests_without_end_is_no_result(tmp_path: Path) -> None:
    (tmp_path / "fig2.json").write_text(100_000 * "[")
    with pytest.raises(TriformError, match="not written by triform reproduce"):
        read_sections(tmp_path, ["fig2"])
