"""Numbers that no work has are refused, and so is more memory than there is, both before any work."""

from __future__ import annotations

import re

import pytest

from triform import limits
from triform.cli import main
from triform.limits import check_threads, memory, require_at_most, require_memory
from triform.types import ConfigurationError


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
    arguments: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    monkeypatch.chdir(str(tmp_path))
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
