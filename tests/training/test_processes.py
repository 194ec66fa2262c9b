from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from triform.dataset import CollectionConfig, SceneConfig, StateConfig, collect
from triform.policy import NetworkConfig
from triform.training import TrainConfig, train
from triform.training.batches import FreshSource, SceneSource, StoredSource, TrainBatch
from triform.training.processes import Processes

#: 33 and 32 maps: shares of unequal size.
SHARED = TrainConfig(
    "shared",
    NetworkConfig(dim=16, depth=2, heads=2, mlp=16),
    maps=240,
    batch_maps=32,
    warmup=5,
    precision="float32",
    states=StateConfig(robots=(3, 4), moved_time=1.0, settled_time=2.0),
)

#: What each process runs; arguments are a folder, the data, whether to resume, the step after which to act, and how.
PROGRAM = """
import os, signal, sys, time
from pathlib import Path
sys.path.insert(0, {folder!r})
from test_processes import SHARED
from triform.training import train
out, data, resume, step, act = Path(sys.argv[1]), sys.argv[2], sys.argv[3] == "resume", int(sys.argv[4]), sys.argv[5]
def report(progress):
    if progress.step == step:
        print("reached", os.getpid(), flush=True)
        if act == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if act == "wait":
            time.sleep(1.0)
try:
    train(SHARED, out, data=Path(data) if data else None, resume=resume, report=report, save_seconds=0.0)
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    small = {"placements": 40, "block_placements": 20, "shard_runs": 5, "group_records": 50}
    collect(folder, CollectionConfig(runs=2, steps=20, validation_share=0.25, **small))
    return folder


def start(
    tmp_path: Path, out: Path, data: Path | None = None, resume: str = "new", step: int = -1, act: str = "go on"
) -> subprocess.Popen[str]:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM.format(folder=str(Path(__file__).parent)))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(program)]
    return subprocess.Popen(
        [*command, str(out), str(data or ""), resume, str(step), act],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


def run(*arguments: object, **options: object) -> tuple[int, str]:
    process = start(*arguments, **options)
    output, _ = process.communicate(timeout=120)
    return process.returncode, output


def assert_close(a: Path, b: Path) -> None:
    first, second = (safetensors.torch.load_file(out / "state.safetensors") for out in (a, b))
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        wanted = second[name]
        if name.endswith("qkv.bias"):
            # A key's bias changes no command, so its gradient is rounding alone, which AdamW blows up.
            dim = len(tensor) // 3
            tensor, wanted = (torch.cat([x[:dim], x[2 * dim :]]) for x in (tensor, wanted))
        torch.testing.assert_close(tensor, wanted, rtol=1e-4, atol=1e-5, msg=name)
    logs = [[json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()] for out in (a, b)]
    for one, other in zip(*logs, strict=True):
        assert (one["step"], one["maps"]) == (other["step"], other["maps"])
        for key in {"loss", "error_mean"} & one.keys():
            assert one[key] == pytest.approx(other[key], rel=1e-4)


def test_two_processes_equal_one(tmp_path: Path) -> None:
    train(SHARED, tmp_path / "one")
    code, output = run(tmp_path, tmp_path / "two")
    assert code == 0, output
    assert_close(tmp_path / "one", tmp_path / "two")


def test_a_process_that_dies_ends_all_and_one_process_goes_on(tmp_path: Path) -> None:
    train(SHARED, tmp_path / "one")
    code, output = run(tmp_path, tmp_path / "two", step=4, act="die")
    assert code != 0
    assert "reached" in output
    train(SHARED, tmp_path / "two", resume=True)
    assert_close(tmp_path / "one", tmp_path / "two")


def test_a_stop_request_to_one_process_stops_all_with_their_state_saved(tmp_path: Path, data: Path) -> None:
    train(SHARED, tmp_path / "one", data=data)
    process = start(tmp_path, tmp_path / "two", data=data, step=3, act="wait")
    for line in process.stdout:
        if line.startswith("reached"):
            os.kill(int(line.split()[1]), signal.SIGTERM)
            break
    process.communicate(timeout=120)
    assert process.returncode != 0
    code, output = run(tmp_path, tmp_path / "two", data=data, resume="resume")
    assert code == 0, output
    assert_close(tmp_path / "one", tmp_path / "two")


def maps_of(batch: TrainBatch) -> list[tuple[bytes, bytes, bytes]]:
    """Patches, positions and command of every map that is meant."""
    ends = np.cumsum(batch.packed.counts)
    cuts = [slice(end - count, end) for end, count in zip(ends, batch.packed.counts, strict=True)]
    return [
        (batch.packed.patches[cut].tobytes(), batch.packed.positions[cut].tobytes(), command.tobytes())
        for cut, command in zip(cuts, batch.commands, strict=False)
    ]


@pytest.mark.parametrize("count", [2, 3, 11])
def test_the_shares_of_all_processes_are_the_mini_batch(data: Path, count: int) -> None:
    network = replace(SHARED.network, outputs=4)
    scenes = replace(SHARED, network=network, scenes=SceneConfig(views=4), teacher="triangulating")
    for source in (FreshSource(SHARED), StoredSource(SHARED, data), SceneSource(scenes)):
        whole = next(source.batches(2))()
        shares = [next(source.batches(2, Processes(rank, count)))() for rank in range(count)]
        assert {share.maps for share in shares} == {whole.maps} == {len(whole.commands)}
        assert [each for share in shares for each in maps_of(share)] == maps_of(whole)
        np.testing.assert_array_equal(np.concatenate([share.features for share in shares]), whole.features)
        assert sum(int(share.valid.sum()) for share in shares) == int(whole.valid.sum())
