"""Losses and auxiliary targets of the triangulating law, by their definitions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from triform.control import TriangulatingLaw
from triform.dataset import SceneConfig, StateBuffer, draw_views
from triform.policy import NetworkConfig, pack
from triform.training import TrainConfig
from triform.training.auxiliary import feature_loss, token_loss, token_targets
from triform.training.batches import SceneSource
from triform.training.flat import FlatParameters
from triform.training.loop import Learner, command_loss, learning_rate, make_optimizer
from triform.types import MapConfig, ScanConfig

CONFIG = TrainConfig(
    "tiny",
    NetworkConfig(dim=32, depth=2, heads=4, mlp=64, outputs=4),
    maps=600,
    batch_maps=24,
    warmup=5,
    teacher="triangulating",
    scenes=SceneConfig(),
)


def test_every_token_is_told_of_the_robot_nearest_to_its_cells() -> None:
    config, patch = MapConfig(), 10
    views = draw_views(
        np.random.default_rng(1), 60, TriangulatingLaw(), SceneConfig(), StateBuffer.none(), ScanConfig(), config
    )
    packed = pack(views.maps, patch)
    targets, valid = token_targets(packed, views.seen, config, patch)
    owners = np.repeat(np.arange(60), packed.counts)
    for token, owner in enumerate(owners):
        row, column = np.divmod(packed.positions[token], config.size // patch)
        cells = np.argwhere(packed.patches[token].reshape(patch, patch)) + [patch * row, patch * column]
        centre = (cells.mean(axis=0) + 0.5) * config.cell - config.half_extent
        offsets = views.seen[owner, :, :2] - centre
        nearest = np.linalg.norm(offsets, axis=1).argmin()
        assert valid[token] == (np.linalg.norm(offsets[nearest]) < 0.45)
        if valid[token]:
            seen = views.seen[owner, nearest]
            np.testing.assert_allclose(targets[token], [*seen[2:4], *(offsets[nearest] / 0.2), *seen[4:]], atol=1e-5)
    assert 0.8 < valid.mean() <= 1.0


def bernoulli(logits: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Cross entropy of shares with logits."""
    shares = 1 / (1 + np.exp(-logits))
    return -(wanted * np.log(shares) + (1 - wanted) * np.log(1 - shares))


def test_losses_are_their_definitions() -> None:
    rng = np.random.default_rng(2)
    predicted, wanted = rng.normal(size=(2, 9, 4))
    error = predicted - wanted
    found = command_loss(torch.tensor(predicted), torch.tensor(wanted), "norm")
    assert float(found) == pytest.approx(np.linalg.norm(error[:, :3], axis=1).sum() + np.abs(error[:, 3]).sum())
    assert float(command_loss(torch.tensor(predicted), torch.tensor(wanted), "mse")) == pytest.approx(
        (error**2).mean(axis=1).sum()
    )
    three = command_loss(torch.tensor(predicted[:, :3]), torch.tensor(wanted[:, :3]), "norm")
    assert float(three) == pytest.approx(np.linalg.norm(error[:, :3], axis=1).sum())

    predicted, features = rng.normal(size=(9, 5)), np.concatenate([rng.random((9, 3)), rng.normal(size=(9, 2))], axis=1)
    gates = bernoulli(predicted[:, :3], features[:, :3]).sum()
    rest = ((predicted[:, 3:] - features[:, 3:]) ** 2).sum()
    assert float(feature_loss(torch.tensor(predicted), torch.tensor(features))) == pytest.approx(0.1 * (gates + rest))

    predicted = rng.normal(size=(9, 6))
    targets = np.concatenate([rng.normal(size=(9, 4)), rng.integers(0, 2, (9, 2))], axis=1)
    valid = rng.random(9) < 0.6
    squares = (predicted[:, :4] - targets[:, :4]) ** 2
    each = squares[:, :2].mean(axis=1) + 0.1 * squares[:, 2:].mean(axis=1)
    each += 0.1 * bernoulli(predicted[:, 4:], targets[:, 4:]).sum(axis=1)
    predicted[~valid] = np.inf
    found = token_loss(torch.tensor(predicted), torch.tensor(targets), torch.tensor(valid))
    assert float(found) == pytest.approx(each[valid].sum())


def test_perfect_commands_leave_a_finite_gradient() -> None:
    wanted = torch.randn(5, 4)
    predicted = wanted.clone().requires_grad_()
    command_loss(predicted, wanted, "norm").backward()
    assert predicted.grad.isfinite().all()


def test_one_batch_of_scenes_can_be_learned_by_heart_with_its_pushes_and_facts() -> None:
    torch.set_num_threads(1)
    batch = next(SceneSource(CONFIG).batches(0))()
    assert (batch.commands[:, 3] > 0).any()
    torch.manual_seed(0)
    learner = Learner(CONFIG)
    parameters = FlatParameters(learner)
    optimizer = make_optimizer(CONFIG, parameters)
    begin = None
    for step in range(300):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(CONFIG, step, 300)
        parameters.gradient.zero_()
        command, total = learner.losses(batch.to(torch.device("cpu")), CONFIG, batch.maps, batch.valid.sum())
        total.backward()
        optimizer.step()
        begin = begin or float(total.detach())
    sizes = np.linalg.norm(batch.commands[:, :3], axis=1) + np.abs(batch.commands[:, 3])
    assert float(command.detach()) < 0.1 * sizes.mean()
    assert float(total.detach()) < 0.3 * begin


def test_heads_are_made_for_what_there_is_to_learn() -> None:
    assert Learner(CONFIG).facts is not None
    without = Learner(replace(CONFIG, auxiliary=0.0))
    assert without.facts is None
    assert without.auxiliary is None
    demonstrated = replace(CONFIG, scenes=None, teacher="expert", network=replace(CONFIG.network, outputs=3))
    assert Learner(demonstrated).facts is None
    assert Learner(demonstrated).policy.state_dict().keys() == Learner(CONFIG).policy.state_dict().keys()
