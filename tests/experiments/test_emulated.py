"""Emulated robots that processes of ``triform drive`` drive, and the paper's Fig. 7 and 8 of them."""

from __future__ import annotations

import json
import os
import subprocess

import numpy as np
import pytest
import shapely

from tests.options import options, scenario
from triform.experiments import real_time as module
from triform.experiments.emulated import EmulatedRun, emulated_teams, run_emulated
from triform.experiments.reproduce import ReproduceConfig, run_reproduce
from triform.figures.style import footprint_outlines
from triform.geometry import body_to_world
from triform.recordings.description import RunSetting
from triform.recordings.kept import open_runs
from triform.recordings.measure import MeasureConfig, run_measure
from triform.robots.emulate import EmulateConfig
from triform.robots.robomaster import RoboMasterEmulator
from triform.types import TriformError


def team(**changes):
    """Two emulated robots at addresses of this process."""
    (own,) = emulated_teams(scenario(), 7, 1)
    given = {"robots": 2, "seed": 3, "address": own.address, "local_address": own.local_address}
    return EmulateConfig(**given | changes)


def children():
    found = subprocess.run(
        ["ps", "--ppid", str(os.getpid()), "-o", "args="], capture_output=True, text=True, check=False
    )
    return [line for line in found.stdout.splitlines() if "triform drive" in line]


@pytest.mark.slow
def test_scans_of_the_processes_show_where_the_robots_truly_were():
    told = []
    found = run_emulated(team(), ["--controller", "scan-pipeline", "--watchdog", "2"], 5.0, told.append)
    assert not children()
    run, (senses,) = found.trajectory, found.trajectory.senses
    np.testing.assert_allclose(run.time, 0.1 * np.arange(51), atol=1e-9)
    assert sum(told) == pytest.approx(5.0)
    assert np.linalg.norm(run.poses[0, -1, :, :2] - run.poses[0, 0, :, :2], axis=1).max() > 0.05
    assert np.isfinite(senses.noise).all()
    (lidar,) = found.setting.lidars
    assert (lidar.rolling, lidar.scan.rays) == (True, senses.scan.rays)
    outlines = [shapely.Polygon(each) for each in footprint_outlines(run.poses[0, -1], [found.setting.footprint] * 2)]
    for robot in range(2):
        ranges, pose = np.asarray(senses.ranges[0, -1, robot], np.float64), run.poses[0, -1, robot]
        near = np.isfinite(ranges)
        angles = senses.scan.angles[near]
        places = ranges[near, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        points = shapely.points(pose[:2] + body_to_world(places, pose[2]))
        assert near.sum() > 3
        # Scans are up to 0.5 s old, and robots drive up to 0.14 m/s.
        assert shapely.distance(outlines[1 - robot], points).max() < 0.25


def test_a_process_that_ends_is_named_and_none_is_left():
    with pytest.raises(TriformError, match=r"^triform drive of emulated robot \d has ended: [^\n]*nowhere[^\n]*$"):
        run_emulated(team(), ["--controller", "policy:nowhere"], 5.0)
    assert not children()


def test_an_address_that_is_taken_is_named_before_any_process_starts():
    config = team()
    with RoboMasterEmulator(config.base_address(1)), pytest.raises(TriformError, match=config.base_address(1)):
        run_emulated(config, [], 5.0)
    assert not children()


@pytest.fixture
def driven(monkeypatch):
    """Runs of the built-in world in the place of those of processes, and how many there were."""
    calls = []

    def run(config, words, duration, on_record):
        calls.append(words)
        chosen = scenario(profile="hardware", duration=duration)
        trajectory, table = chosen.run(config.draw_start()[None], "scan-pipeline", config.index, scans=True)
        on_record(duration)
        return EmulatedRun(trajectory, RunSetting.of(chosen, config.robots), table)

    monkeypatch.setattr(module, "run_emulated", run)
    return calls


def test_fig_8_shows_the_runs_of_fig_7(tmp_path, listener, driven):
    given = {"controller": "scan-pipeline", "duration": 5.0, "guard": "none", "output": tmp_path}
    run_reproduce(options(ReproduceConfig, what="fig7", **given), listener)
    assert driven == [["--controller", "scan-pipeline", "--watchdog", "2", "--no-guard"]] * 2
    run_reproduce(options(ReproduceConfig, what="fig8", **given), listener)
    assert len(driven) == 2
    run_reproduce(options(ReproduceConfig, what="fig8", seed=8, **given), listener)
    assert len(driven) == 4
    names = {f"{figure}.{kind}" for figure in ("fig7", "fig8") for kind in ("png", "pdf", "json", "parquet")}
    assert {path.name for path in tmp_path.iterdir()} == {*names, "index.md", "index.html"}
    page = (tmp_path / "index.md").read_text()
    assert page.count("No real robot drove here") == 2
    about = json.loads((tmp_path / "fig7.json").read_text())
    assert about["config"]["profile"] == "hardware"
    runs = open_runs(tmp_path / "fig7.parquet")
    assert runs.has_scans
    assert len(runs) == 2
    # What is kept is a recording with maps in its own Fig. 7.
    found = run_measure(MeasureConfig((tmp_path / "fig7.parquet",), figures=tmp_path / "figures"))
    errors = [each["formation_error_median"] for each in about["results"]]
    assert sorted(found.runs["formation_error"].tolist()) == sorted(errors)
    assert (tmp_path / "figures" / "fig7.png").stat().st_size > 50_000
