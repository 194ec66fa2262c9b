from __future__ import annotations

import json
import multiprocessing
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from triform.dataset import CollectionConfig, StateConfig, collect
from triform.policy import NetworkConfig
from triform.policy.checkpoint import read_weights
from triform.policy.vit import token_batch
from triform.training import PRESETS, Progress, TrainConfig, batches, train
from triform.training.batches import FreshSource, StoredSource
from triform.training.flat import FlatParameters
from triform.training.loop import Learner, learning_rate, make_optimizer
from triform.training.state import load_state, save_state
from triform.types import ConfigurationError, TriformError

TINY = TrainConfig(
    "tiny",
    NetworkConfig(dim=16, depth=1, heads=2, mlp=16),
    maps=600,
    batch_maps=20,
    warmup=5,
    teacher="expert",
    states=StateConfig(robots=(3, 4), moved_time=1.0, settled_time=2.0),
)


@pytest.fixture(autouse=True)
def small_and_quick(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.set_num_threads(1)
    monkeypatch.setattr(batches, "VALIDATION_MAPS", 200)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    small = {"placements": 100, "block_placements": 25, "shard_runs": 5, "group_records": 50}
    collect(folder, CollectionConfig(runs=4, steps=20, validation_share=0.25, **small))
    return folder


def tensors(out: Path) -> dict[str, torch.Tensor]:
    return safetensors.torch.load_file(out / "state.safetensors")


def stop_at(step: int):
    def report(progress: Progress) -> None:
        if progress.step == step:
            raise KeyboardInterrupt

    return report


def assert_same_end(a: Path, b: Path) -> None:
    first, second = tensors(a), tensors(b)
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name
    for name in ("best", "last"):
        assert read_weights(a / name) == read_weights(b / name)

    def scalars(out: Path) -> list[dict]:
        lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
        return [
            {key: value for key, value in line.items() if key not in ("maps_per_second", "share_waiting_for_data")}
            for line in lines
        ]

    assert scalars(a) == scalars(b)


@pytest.mark.parametrize(("optimizer", "precision"), [("adamw", "bfloat16"), ("rmsprop", "medium")])
def test_interrupted_and_resumed_equals_uninterrupted(tmp_path: Path, optimizer: str, precision: str) -> None:
    config = replace(TINY, optimizer=optimizer, precision=precision, learning_rate=1e-3)
    train(config, tmp_path / "whole", producers=3)
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "parts", report=stop_at(17), save_seconds=0.0)
    train(config, tmp_path / "parts", resume=True)
    assert_same_end(tmp_path / "whole", tmp_path / "parts")


def _train_slowly(out: Path) -> None:
    torch.set_num_threads(1)
    batches.VALIDATION_MAPS = 200
    train(TINY, out, report=lambda _: time.sleep(0.02), save_seconds=0.0)


def test_killed_and_resumed_equals_uninterrupted(tmp_path: Path) -> None:
    train(TINY, tmp_path / "whole")
    child = multiprocessing.get_context("spawn").Process(target=_train_slowly, args=(tmp_path / "killed",))
    child.start()
    state = tmp_path / "killed" / "state.safetensors"
    while not state.exists():
        time.sleep(0.02)
        assert child.is_alive() or state.exists()
    os.kill(child.pid, signal.SIGKILL)
    child.join()
    train(TINY, tmp_path / "killed", resume=True)
    assert_same_end(tmp_path / "whole", tmp_path / "killed")


def test_stored_demonstrations_resume_exactly_across_epochs(tmp_path: Path, data: Path) -> None:
    config = replace(TINY, maps=2000, batch_maps=70)
    train(config, tmp_path / "whole", data=data)
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "parts", data=data, report=stop_at(21), save_seconds=0.0)
    train(config, tmp_path / "parts", data=data, resume=True)
    assert_same_end(tmp_path / "whole", tmp_path / "parts")


def test_algorithm_1_is_one_epoch_of_16_records(data: Path) -> None:
    source = StoredSource(PRESETS["paper"], data)
    epoch = [task() for _, task in zip(range(source.steps), source.batches(0), strict=False)]
    assert [len(batch.commands) for batch in epoch[:-1]] == [112] * (source.steps - 1)
    assert sum(len(batch.commands) for batch in epoch) == 7 * (3 * 20 + 75)
    assert set(epoch[0].packed.counts) == {100}


def test_another_teacher_labels_stored_states_anew(data: Path) -> None:
    stored, anew = (
        next(StoredSource(replace(TINY, teacher=name), data).batches(0))() for name in ("expert", "expert-odd")
    )
    np.testing.assert_array_equal(stored.packed.patches, anew.packed.patches)
    assert not np.allclose(stored.commands, anew.commands)


def test_one_batch_can_be_learned_by_heart() -> None:
    config = replace(TINY, network=NetworkConfig(dim=32, depth=2, heads=4, mlp=64), batch_maps=24)
    batch = next(FreshSource(config).batches(0))()
    torch.manual_seed(0)
    learner = Learner(config)
    parameters = FlatParameters(learner)
    optimizer = make_optimizer(config, parameters)
    for step in range(400):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(config, step, 400)
        parameters.gradient.zero_()
        command, total = learner.losses(batch.to(torch.device("cpu")), config, batch.maps, batch.valid.sum())
        total.backward()
        optimizer.step()
    assert float(command.detach()) < 0.05 * float(np.linalg.norm(batch.commands, axis=1).mean())


def test_the_auxiliary_loss_does_not_change_the_policy_that_is_saved() -> None:
    with_head, without = Learner(TINY), Learner(replace(TINY, auxiliary=0.0))
    assert with_head.policy.state_dict().keys() == without.policy.state_dict().keys()


def test_fresh_batches_are_functions_of_seed_and_number() -> None:
    source = FreshSource(TINY)
    third = [next(source.batches(3))(), list(zip(range(4), source.batches(0), strict=False))[3][1]()]
    np.testing.assert_array_equal(third[0].commands, third[1].commands)
    np.testing.assert_array_equal(third[0].packed.patches, third[1].packed.patches)
    other = next(FreshSource(replace(TINY, seed=2)).batches(3))()
    assert not np.array_equal(other.packed.patches, third[0].packed.patches)


def test_auxiliary_targets_tell_where_the_robot_is() -> None:
    config = replace(TINY, states=StateConfig(robots=(2,), moved=0.0, settled=0.0), batch_maps=200)
    batch = next(FreshSource(config).batches(0))()
    assert batch.valid[batch.packed.patches.any(1)].mean() > 0.99
    tokens = token_batch(batch.packed)
    assert tokens.patches.shape[0] == len(batch.targets)
    # With one other robot, its term of Eq. 8 is the whole command, up to the clip at 1 m/s.
    owner = np.repeat(np.arange(len(batch.packed.counts)), batch.packed.counts)
    np.testing.assert_allclose(batch.targets[batch.valid, :2], batch.commands[owner[batch.valid], :2], atol=1e-5)
    assert (batch.targets[batch.valid, 4] == 1).all()


@pytest.mark.parametrize(("step", "share"), [(0, 0.2), (4, 1.0), (50, 0.5), (100, 0.0)])
def test_learning_rate_warms_up_and_decays(step: int, share: float) -> None:
    assert learning_rate(TINY, step, 100) == pytest.approx(TINY.learning_rate * share, rel=0.01, abs=1e-12)


def test_wrong_use_is_refused_and_loses_nothing(tmp_path: Path, data: Path) -> None:
    with pytest.raises(TriformError, match="holds no training run to resume"):
        train(TINY, tmp_path / "none", resume=True)
    train(TINY, tmp_path / "run")
    before = (tmp_path / "run" / "state.safetensors").read_bytes()
    with pytest.raises(TriformError, match="already holds a training run"):
        train(TINY, tmp_path / "run")
    with pytest.raises(TriformError, match="other settings"):
        train(replace(TINY, seed=9), tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "state.safetensors").read_bytes() == before
    with pytest.raises(TriformError, match="--data"):
        train(PRESETS["paper"], tmp_path / "paper")
    with pytest.raises(TriformError, match="distance"):
        train(replace(TINY, distance=0.8), tmp_path / "distance", data=data)
    (tmp_path / "run" / "state.safetensors").write_bytes(b"nonsense")
    with pytest.raises(TriformError, match="cannot resume"):
        train(TINY, tmp_path / "run", resume=True)
    module = torch.nn.Linear(3, 2)
    optimizer = torch.optim.AdamW(module.parameters())
    path = tmp_path / "small.safetensors"
    save_state(path, module, optimizer, {"step": 3, "best": 0.25})
    whole, weights = path.read_bytes(), [each.detach().clone() for each in module.parameters()]
    assert load_state(path, module, optimizer) == {"step": 3, "best": 0.25}
    for k in range(0, 8 * len(whole), 7):
        path.write_bytes(whole[: k // 8] + bytes([whole[k // 8] ^ 1 << k % 8]) + whole[k // 8 + 1 :])
        with pytest.raises(TriformError, match="cannot resume"):
            load_state(path, module, optimizer)
        assert all(torch.equal(*pair) for pair in zip(module.parameters(), weights, strict=True))
    with pytest.raises(ConfigurationError, match="learning_rate"):
        replace(TINY, learning_rate=0.0)
    with pytest.raises(ConfigurationError, match="precision"):
        replace(TINY, precision="float16")
    with pytest.raises(ConfigurationError, match="producers"):
        train(TINY, tmp_path / "producers", producers=0)
    with pytest.raises(TriformError, match="other settings"):
        train(replace(TINY, precision="bfloat16"), tmp_path / "run", resume=True)


def test_weights_that_are_not_finite_are_never_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    losses = Learner.losses

    def poisoned(self: Learner, *given: object) -> tuple:
        command, total = losses(self, *given)
        return command, total * (float("nan") if len(list((tmp_path / "run").glob("state*"))) else 1.0)

    monkeypatch.setattr(Learner, "losses", poisoned)
    with pytest.raises(TriformError, match="diverged at step 2"):
        train(TINY, tmp_path / "run", save_seconds=0.0)
    monkeypatch.undo()
    assert all(tensor.isfinite().all() for tensor in tensors(tmp_path / "run").values())
    train(TINY, tmp_path / "run", resume=True)


def test_divergence_stops_the_training(tmp_path: Path) -> None:
    with pytest.raises(TriformError, match="diverged"):
        train(replace(TINY, learning_rate=1e30, optimizer="rmsprop", clip=0.0, loss="mse"), tmp_path / "run")
