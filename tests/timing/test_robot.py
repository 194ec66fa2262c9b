from __future__ import annotations

import json
import time

import numpy as np
import pytest

from triform.control import ControllerSpec
from triform.evaluation.scenario import Scenario
from triform.robots.ldrobot import LD20, PacketParser, TurnAssembler
from triform.timing import robot as robot_bench
from triform.timing.robot import BenchConfig, judge, run_bench
from triform.timing.robot_step import STAGES, Job, as_packets, load_moments, measure, save_moments
from triform.timing.step_time import record_views, single_views
from triform.types import ConfigurationError, TriformError


@pytest.fixture(scope="module")
def views():
    return single_views(record_views(Scenario(profile="hardware"), 3))[::20]


def test_moments_are_read_as_they_were_written(views, tmp_path):
    save_moments(tmp_path / "scans.npz", views)
    moments = load_moments(tmp_path / "scans.npz")
    assert len(moments) == len(views)
    for moment, view in zip(moments, views, strict=True):
        np.testing.assert_array_equal(moment.view.scans.ranges, view.scans.ranges)
        np.testing.assert_array_equal(moment.view.noise, view.noise)
        np.testing.assert_array_equal(moment.view.odometry, view.odometry)
        assert moment.view.scans.config == view.scans.config
        assert moment.view.time == view.time


def test_the_driver_reads_the_scan_from_the_packets(views):
    scan = views[0].scans
    parser, assembler = PacketParser(), TurnAssembler(LD20, scan.config)
    turns = []
    for turn in range(3):
        data = as_packets(scan.ranges[0, 0], turn).tobytes()
        turns += assembler.add(parser.feed(data), (turn + 1) * LD20.period)
    assert parser.skipped == 0
    found, given = turns[0].ranges, scan.ranges[0, 0]
    # Samples lie between rays, so a ray at the edge of a robot may show what stands beside it.
    same = np.isclose(found, given, atol=1e-3) | (np.isfinite(found) == np.isfinite(given)) & ~np.isfinite(given)
    neighbours = np.isclose(found, np.roll(given, 1), atol=1e-3) | np.isclose(found, np.roll(given, -1), atol=1e-3)
    assert (same | neighbours).mean() > 0.95
    assert same.mean() > 0.8


def test_every_stage_is_timed(views, tmp_path):
    save_moments(tmp_path / "scans.npz", views)
    found = measure(Job(time.monotonic(), None, 1.0, 0.05), load_moments(tmp_path / "scans.npz"))
    assert found["steps"]["cold"] >= 100
    for caches in ("warm", "cold"):
        quantiles = found["seconds"][caches]
        assert tuple(quantiles) == STAGES
        for each in quantiles.values():
            assert 0 < each["median"] <= each["p95"] <= each["p99"] <= each["max"]
        assert all(quantiles[stage]["max"] <= quantiles["all"]["max"] for stage in STAGES)
    assert found["peak_memory"] > 2**25


@pytest.mark.slow
def test_bench_needs_nothing_but_the_base_install(tmp_path, listener):
    run_bench(BenchConfig(seconds=0.1, json=tmp_path / "bench.json"), listener)
    found = json.loads((tmp_path / "bench.json").read_text())
    assert found["start_compiling"]["first"] > found["start"]["first"]
    assert found["machine"]["packages"]["onnxruntime"] != "not installed"
    shown = listener.console.file.getvalue()
    assert "keep up with 8 Hz" in shown or "keeps up with 8 Hz" in shown


def test_a_stage_that_is_too_slow_is_named():
    fast = {"median": 0.001, "p95": 0.002, "p99": 0.004, "max": 0.2}
    sentences, keeps_up = judge(dict.fromkeys(STAGES, fast), 8.0)
    assert keeps_up
    assert sentences == [
        "keeps up with 8 Hz: 99 of 100 steps take 4.00 ms or less with cold caches, 3.2 % of a control period of "
        "125.0 ms"
    ]
    slow = dict.fromkeys(STAGES, fast) | {"policy": fast | {"p99": 0.13}}
    sentences, keeps_up = judge(slow, 8.0)
    assert not keeps_up
    assert sentences == ["map to command: CANNOT keep up with 8 Hz: 1 step of 100 takes 130.0 ms or more of 125.0 ms"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"controller": ControllerSpec("expert")}, "controller is 'expert'; the bench times a policy"),
        ({"rate": 0.0}, "rate is 0.0 Hz"),
        ({"seconds": 0.0}, "seconds is 0.0"),
        ({"seed": -1}, "seed is -1"),
        ({"distance": -1.0}, "distance is -1.0 m"),
    ],
)
def test_bad_settings_are_refused(changes, message):
    with pytest.raises(ConfigurationError, match=f"^[^\n]*{message}"):
        BenchConfig(**changes)


def test_weights_that_are_not_there_are_refused_first(listener):
    with pytest.raises(TriformError, match="there is no policy 'none'"):
        run_bench(BenchConfig(controller=ControllerSpec("policy", "none")), listener)


def test_a_process_that_fails_is_told_of_in_one_sentence(listener, monkeypatch, tmp_path):
    monkeypatch.setattr(robot_bench.sys, "executable", "false")
    with pytest.raises(TriformError, match="failed with status 1: it said nothing"):
        robot_bench._measure(BenchConfig(), tmp_path, 0.0)
