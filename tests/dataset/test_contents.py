"""What is collected, checked against the rooms it comes from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from triform.control import Expert
from triform.dataset import Demonstrations, collect
from triform.dataset.demonstrate import demonstrate
from triform.dataset.sensing import sense
from triform.engines import LocalEngine
from triform.perception import occupancy_maps
from triform.simulation import ROBOMASTER_EP, Arena, Footprint, cast_scans, sample_starts
from triform.types import FloatArray, MapArray, MapConfig, PrivilegedView, Scan, ScanConfig

from .conftest import SMALL


def maps_of(poses: FloatArray, footprint: Footprint, scan: ScanConfig, map_config: MapConfig) -> MapArray:
    """Maps (M, H, W) by the way a robot makes them."""
    ranges = cast_scans(poses, np.ones(poses.shape[:2], dtype=bool), footprint, Arena.open(), scan)
    return occupancy_maps(Scan(ranges, scan), map_config).reshape(-1, map_config.size, map_config.size)


def expert_commands(poses: FloatArray, sensing_range: float) -> FloatArray:
    active = np.ones(poses.shape[:2], dtype=bool)
    scans = Scan(np.full((*poses.shape[:2], 4), np.inf), ScanConfig(rays=4))
    return Expert(sensing_range=sensing_range).command(PrivilegedView(scans, active, 0.0, poses))


def test_pandas_opens_the_shards_and_finds_every_record(small_folder: Path) -> None:
    table = pd.read_parquet(small_folder / "shards")
    assert len(table) == SMALL.records
    assert not table.duplicated(["run", "step"]).any()
    assert (table["kind"] == np.where(table["run"] < SMALL.runs, "roll-out", "placement")).all()
    poses = np.stack(table["poses"]).reshape(-1, SMALL.robots, 3)
    commands = np.stack(table["commands"]).reshape(-1, SMALL.robots, 3)

    assert poses.dtype == np.float64
    assert commands.dtype == np.float32
    np.testing.assert_array_equal(commands, expert_commands(poses, np.inf).astype(np.float32))
    dense = maps_of(poses, SMALL.footprint, SMALL.scan, SMALL.map)
    stored = [cells for record in table["cells"] for cells in record]
    assert len(stored) == len(dense)
    for cells, each in zip(stored, dense, strict=True):
        np.testing.assert_array_equal(cells, np.flatnonzero(each))


def test_pyarrow_opens_a_shard(small_folder: Path) -> None:
    table = pq.read_table(small_folder / "shards" / "shard-00000.parquet")
    assert table.column_names == ["run", "step", "kind", "poses", "commands", "cells"]
    assert table.num_rows == 2 * SMALL.steps


def test_the_manifest_says_what_is_there(small_folder: Path) -> None:
    manifest = json.loads((small_folder / "manifest.json").read_text())
    assert manifest["complete"] is True
    assert manifest["configuration"]["seed"] == SMALL.seed
    assert manifest["counts"]["maps"] == SMALL.maps
    assert sum(shard["records"] for shard in manifest["shards"]) == SMALL.records
    assert manifest["versions"].keys() == {"numba", "numpy", "pyarrow", "triform"}
    assert manifest["validation_runs"] == SMALL.validation_runs().tolist()


def test_roll_outs_obey_the_speed_limit_and_follow_the_teacher() -> None:
    for run, (poses, commands) in enumerate(demonstrate(SMALL, range(SMALL.runs))):
        np.testing.assert_array_equal(
            poses[0], sample_starts(SMALL.robots, 1, SMALL.start_seed(placements=False), first=run)[0]
        )
        cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
        u_x, u_y = commands[..., 0], commands[..., 1]
        velocity = np.stack([cos * u_x - sin * u_y, sin * u_x + cos * u_y], axis=-1)
        speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
        assert speed.max() <= SMALL.max_speed + 1e-12
        followed = velocity * np.minimum(1.0, SMALL.speed_limit / np.maximum(speed, 1e-300))
        np.testing.assert_allclose(np.diff(poses[..., :2], axis=0), SMALL.step_period * followed[:-1], atol=1e-12)
        np.testing.assert_allclose(poses[..., 2], np.broadcast_to(poses[0, :, 2], poses.shape[:2]), atol=1e-12)


def test_placements_are_valid_starts_that_never_repeat() -> None:
    runs = range(SMALL.runs, SMALL.all_runs)
    poses = np.concatenate([each for each, _ in demonstrate(SMALL, runs)])
    assert len(poses) == SMALL.placements
    seed = SMALL.start_seed(placements=True)
    np.testing.assert_array_equal(poses, sample_starts(SMALL.robots, SMALL.placements, seed))
    assert len(np.unique(poses[:, 0, 0])) == len(poses)


def test_a_run_does_not_depend_on_the_runs_computed_with_it() -> None:
    together = demonstrate(SMALL, range(SMALL.all_runs))
    for run in (0, 4, SMALL.runs, SMALL.all_runs - 1):
        alone = demonstrate(SMALL, [run])[0]
        np.testing.assert_array_equal(alone[0], together[run][0])
        np.testing.assert_array_equal(alone[1], together[run][1])


def test_the_unlimited_expert_can_teach() -> None:
    config = replace(SMALL, teacher="expert", robots=9)
    poses, commands = demonstrate(config, [config.runs])[0]
    np.testing.assert_array_equal(commands, expert_commands(poses, np.inf))
    assert not np.array_equal(commands, expert_commands(poses, 2.0))


def test_jitter_moves_what_is_recorded_and_not_what_is_driven() -> None:
    plain = demonstrate(SMALL, [2])[0]
    poses, commands = demonstrate(replace(SMALL, jitter=(0.0, 0.02)), [2])[0]
    np.testing.assert_array_equal(poses[::2], plain[0][::2])
    np.testing.assert_array_equal(poses[..., 2], plain[0][..., 2])
    np.testing.assert_array_equal(commands, expert_commands(poses, 2.0))
    offsets = (poses - plain[0])[1::2, :, :2]
    assert 0.015 < offsets.std() < 0.025


@pytest.mark.parametrize(
    ("footprint", "scan", "map_config"),
    [
        (ROBOMASTER_EP, ScanConfig(), MapConfig()),
        (Footprint.circle(0.3), ScanConfig(rays=667, angle_min=0.0, range_min=0.1, range_max=3.0), MapConfig()),
        (ROBOMASTER_EP, ScanConfig(), MapConfig(size=200, cell=0.02, min_cells=0, max_cells=9999)),
        (ROBOMASTER_EP, ScanConfig(rays=3), MapConfig(size=5, cell=1.0, min_cells=1)),
    ],
)
def test_sensed_cells_are_those_of_the_robots_own_way(
    footprint: Footprint, scan: ScanConfig, map_config: MapConfig
) -> None:
    poses = sample_starts(6, 40, 5)
    cells, offsets = sense(poses, footprint, scan, map_config)
    dense = maps_of(poses, footprint, scan, map_config)
    assert dense.any()
    for m, each in enumerate(dense):
        np.testing.assert_array_equal(cells[offsets[m] : offsets[m + 1]], np.flatnonzero(each))


@pytest.mark.parametrize("robots", [1, 2])
def test_lonely_robots_have_data_sets_too(tmp_path: Path, robots: int) -> None:
    config = replace(SMALL, robots=robots, runs=2, steps=3, placements=4)
    collect(tmp_path, config, engine=LocalEngine(1))
    records = next(Demonstrations.open(tmp_path).batches("train", 100))
    assert records.maps().shape == (len(records) * robots, 100, 100)
    assert records.maps().any() == (robots == 2)


def test_large_maps_need_wider_cell_indices(tmp_path: Path) -> None:
    config = replace(SMALL, runs=0, placements=20, map=MapConfig(size=200, cell=0.02, max_cells=600))
    collect(tmp_path, config, engine=LocalEngine(1))
    batch = next(Demonstrations.open(tmp_path).batches("train", 100, shuffle=False))
    assert batch.cells.dtype == np.int32
    np.testing.assert_array_equal(batch.maps(), maps_of(batch.poses, config.footprint, config.scan, config.map))
