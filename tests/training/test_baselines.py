from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from triform.control import TriangulatingLaw
from triform.dataset import SceneConfig, StateBuffer, fresh_inputs
from triform.policy import CnnConfig, GnnConfig, Network, NetworkConfig, RadiusGraph
from triform.policy.export import export_policy
from triform.training import PRESETS, TrainConfig, batches, dagger, train
from triform.training.batches import TrainBatch, open_source
from triform.training.dagger import Rollouts
from triform.training.flat import FlatParameters
from triform.training.loop import Learner, make_optimizer
from triform.training.processes import Processes
from triform.types import ConfigurationError, TriformError

NETWORKS: dict[str, Network] = {
    "cnn": CnnConfig(stem=4, channels=16, depth=1, squeeze=8, dim=32, mlp=32),
    "gnn": GnnConfig(dim=24, rounds=2, mlp=32),
    "vit": NetworkConfig(dim=16, depth=1, heads=2, mlp=16, outputs=4),
}


def tiny(kind: str) -> TrainConfig:
    return TrainConfig(
        "tiny",
        NETWORKS[kind],
        maps=160,
        batch_maps=20,
        warmup=5,
        teacher="triangulating",
        scenes=SceneConfig(sizes=(2, 8)),
        rounds=(0.5,),
    )


@pytest.fixture(autouse=True)
def small_and_quick(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.set_num_threads(1)
    monkeypatch.setattr(batches, "VALIDATION_MAPS", 40)


@pytest.mark.parametrize("kind", ["cnn", "gnn"])
def test_one_batch_can_be_learned_by_heart(kind: str) -> None:
    config = replace(tiny(kind), learning_rate=4e-3)
    batch = next(open_source(config, None).batches(0))()
    torch.manual_seed(0)
    learner = Learner(config)
    parameters = FlatParameters(learner)
    optimizer = make_optimizer(config, parameters)
    here, first = batch.to(torch.device("cpu")), 0.0
    for step in range(300):
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * (1 - step / 300)
        parameters.gradient.zero_()
        command, total = learner.losses(here, config, batch.maps, float(batch.valid.sum()))
        total.backward()
        optimizer.step()
        first = first or float(total.detach())
    size = float(np.linalg.norm(batch.commands[:, :3], axis=1).mean() + np.abs(batch.commands[:, 3]).mean())
    assert float(command.detach()) < 0.1 * size
    assert float(total.detach()) < 0.2 * first


@pytest.mark.parametrize("kind", ["cnn", "gnn"])
def test_training_visits_exports_and_continues(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = (Rollouts(4, 3, 3.0),)
    teacher = dagger.teacher_states
    monkeypatch.setattr(dagger, "teacher_states", lambda law, seed: teacher(law, seed, few))
    learner = dagger.learner_states
    monkeypatch.setattr(dagger, "learner_states", lambda *given: learner(*given, few))
    config = tiny(kind)
    best = train(config, tmp_path / "run")
    states = [StateBuffer.load(tmp_path / "run" / f"visited-{number}.npz") for number in range(2)]
    assert all(len(each) > 5 for each in states)
    fresh = fresh_inputs(np.random.default_rng(0), 50, config.spec())
    assert export_policy(best, fresh).largest <= 1e-4
    with pytest.raises(TriformError, match="other settings"):
        train(replace(config, network=NETWORKS["vit"]), tmp_path / "run", resume=True)


def test_a_mini_batch_of_teams_has_as_many_robots_as_one_of_maps() -> None:
    config = tiny("gnn")
    batch = next(open_source(config, None).batches(0))()
    assert isinstance(batch.packed, RadiusGraph)
    assert batch.maps == len(batch.commands) == len(batch.features) == config.batch_maps
    assert config.batch_maps <= batch.packed.robots < config.batch_maps + 8
    assert len(batch.targets) == len(batch.valid) == len(batch.packed.receivers)
    assert batch.valid.any()
    assert not batch.valid[batch.packed.receivers >= config.batch_maps].any()
    again = next(open_source(config, None).batches(0))()
    np.testing.assert_array_equal(batch.commands, again.commands)


@pytest.mark.parametrize("count", [2, 3, 30])
def test_processes_share_a_mini_batch_of_teams(count: int) -> None:
    config = replace(tiny("gnn"), batch_maps=50)
    source = open_source(config, None)
    whole = next(source.batches(7))()
    shares: list[TrainBatch] = [next(source.batches(7, Processes(rank, count)))() for rank in range(count)]
    for name in ("commands", "features", "targets", "valid"):
        np.testing.assert_array_equal(
            np.concatenate([getattr(each, name) for each in shares]), getattr(whole, name), name
        )
    assert {each.maps for each in shares} == {50}
    learner = Learner(config)

    def sums(batch: TrainBatch) -> np.ndarray:
        with torch.no_grad():
            return np.array([float(loss) for loss in learner.losses(batch.to(torch.device("cpu")), config, 50, 99.0)])

    np.testing.assert_allclose(sum(sums(each) for each in shares), sums(whole), rtol=1e-4)


def test_baselines_learn_from_the_same_as_the_policy() -> None:
    policy = PRESETS["near"]
    for name in ("cnn", "gnn", "dense"):
        preset = PRESETS[name]
        same = replace(preset, preset="near", network=policy.network, learning_rate=policy.learning_rate)
        assert same == policy
        assert preset.preset == name
        assert preset.network.outputs == 4


def test_a_graph_network_needs_scenes() -> None:
    with pytest.raises(ConfigurationError, match="needs scenes"):
        TrainConfig("odd", GnnConfig(), maps=100, law=TriangulatingLaw())
