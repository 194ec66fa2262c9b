"""The fuzz target of LDROBOT's LiDARs, for a short time: by Hypothesis, and by the fuzzer if it is there."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.fuzz_lidar import check


@settings(deadline=None, max_examples=100)
@given(st.binary(max_size=300))
def test_all_holds_for_any_bytes(data: bytes) -> None:
    check(data)


def test_all_holds_for_long_turns() -> None:
    """Many turns by one script: a LiDAR that turns, with damage and pauses between."""
    turning = bytes([255]) + bytes(range(105))
    for head in range(8):
        script = bytes([head, 99, 60, 30]) + 12 * (turning + bytes([130, 5]) + b"\x54\x2c\x54\x2c\x54" + b"\x64\x09")
        fed, turns = check(script)
        assert fed > 40_000
        assert turns > 10


@pytest.mark.skipif(find_spec("atheris") is None, reason="needs atheris")
def test_the_fuzzer_finds_nothing(tmp_path: Path) -> None:
    result = subprocess.run(
        [sys.executable, "-m", "tests.fuzz.fuzz_lidar", str(tmp_path), "-runs=300", "-max_len=512", "-seed=1"],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert result.returncode == 0, result.stderr[-2000:]
    assert "Done 300 runs" in result.stderr
    assert list(tmp_path.iterdir())
