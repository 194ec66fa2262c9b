"""Learning from scenes in rounds: which states are drawn from, and that a killed training goes on where it was."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from dataclasses import replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from triform.control import Triangulating, TriangulatingLaw
from triform.dataset import SceneConfig, StateBuffer, joined
from triform.policy import NetworkConfig
from triform.policy.vit import VisionTransformer
from triform.simulation import World, get_profile
from triform.training import PRESETS, Progress, TrainConfig, batches, dagger, train
from triform.training.batches import SceneSource
from triform.training.dagger import Rollouts, learner_states, teacher_states
from triform.training.precision import matrix_products
from triform.types import ConfigurationError, TriformError

TEACHER = (Rollouts(3, 2, 2.0), Rollouts(4, 1, 3.0))
LEARNER = (Rollouts(3, 1, 2.0), Rollouts(4, 2, 2.0, "hardware"))
#: 30 steps; rounds begin after 9 and 21.
TINY = TrainConfig(
    "tiny",
    NetworkConfig(dim=16, depth=1, heads=2, mlp=16, outputs=4),
    maps=600,
    batch_maps=20,
    warmup=5,
    teacher="triangulating",
    scenes=SceneConfig(views=4),
    rounds=(0.3, 0.7),
    rest_speed=0.02,
    least_push=0.05,
)


def small_visits(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(dagger, "teacher_states", partial(teacher_states, rollouts=TEACHER))
    patch.setattr(dagger, "learner_states", partial(learner_states, rollouts=LEARNER))
    patch.setattr(batches, "VALIDATION_MAPS", 100)


@pytest.fixture(autouse=True)
def small_and_quick(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.set_num_threads(1)
    small_visits(monkeypatch)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training from its beginning to its end."""
    out = tmp_path_factory.mktemp("training") / "whole"
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        small_visits(patch)
        train(TINY, out)
    return out


def results(out: Path) -> dict[str, bytes]:
    policies = {name: b"".join(f.read_bytes() for f in sorted((out / name).iterdir())) for name in ("best", "last")}
    states = sorted(out.glob("visited-*.npz"))
    listed = {path.name: StateBuffer.load(path).positions.tobytes() for path in states}
    return {"state": (out / "state.safetensors").read_bytes(), **policies, **listed}


def stop_at(step: int):
    def report(progress: Progress) -> None:
        if progress.step == step:
            raise KeyboardInterrupt

    return report


def never(*_: object) -> StateBuffer:
    raise AssertionError("states are visited again")


@pytest.mark.parametrize("step", [4, 9, 10, 24])
def test_interrupted_in_any_round_and_resumed_equals_uninterrupted(tmp_path: Path, whole: Path, step: int) -> None:
    with pytest.raises(KeyboardInterrupt):
        train(TINY, tmp_path / "parts", report=stop_at(step), save_seconds=0.0)
    rounds = [path.name for path in sorted((tmp_path / "parts").glob("visited-*"))]
    assert rounds == [f"visited-{number}.npz" for number in range(1 + (step > 9) + (step > 21))]
    train(TINY, tmp_path / "parts", resume=True)
    assert results(tmp_path / "parts") == results(whole)


def _train_slowly(out: Path) -> None:
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        small_visits(patch)
        train(TINY, out, report=lambda _: time.sleep(0.05), save_seconds=0.0)


def test_killed_in_a_round_and_resumed_equals_uninterrupted(tmp_path: Path, whole: Path) -> None:
    child = multiprocessing.get_context("spawn").Process(target=_train_slowly, args=(tmp_path,))
    child.start()
    while not (tmp_path / "visited-1.npz").exists():
        time.sleep(0.02)
        assert child.is_alive()
    os.kill(child.pid, signal.SIGKILL)
    child.join()
    train(TINY, tmp_path, resume=True)
    assert results(tmp_path) == results(whole)


def test_a_resumed_training_visits_nothing_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(KeyboardInterrupt):
        train(TINY, tmp_path, report=stop_at(24), save_seconds=0.0)
    for name in ("teacher_states", "learner_states"):
        monkeypatch.setattr(dagger, name, never)
    train(TINY, tmp_path, resume=True)


def test_every_round_draws_from_all_states_so_far(tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[StateBuffer] = []
    draw_views = batches.draw_views

    def watched(rng, maps, law, config, visited, *rest):
        drawn.append(visited)
        return draw_views(rng, maps, law, config, visited, *rest)

    monkeypatch.setattr(batches, "draw_views", watched)
    train(TINY, tmp_path)
    parts = [StateBuffer.load(path) for path in sorted(tmp_path.glob("visited-*.npz"))]
    assert len(parts) == 3
    assert len({part.positions.tobytes() for part in parts}) == 3
    # The teacher's for validation and the first round, and then more from round to round.
    seen = [next(group).positions for _, group in groupby(drawn, key=lambda states: states.positions.tobytes())]
    for found, wanted in zip(seen, [joined(parts[:k]) for k in range(1, 4)], strict=True):
        np.testing.assert_array_equal(found, wanted.positions)


def teams(states: StateBuffer) -> list[np.ndarray]:
    return [states.positions[a:b] for a, b in zip(states.offsets[:-1], states.offsets[1:], strict=True)]


def test_teacher_states_are_where_the_law_takes_teams(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[World] = []
    monkeypatch.setattr(dagger, "World", lambda *given, **named: made.append(World(*given, **named)) or made[-1])
    law = TriangulatingLaw(gain=1.5)
    states = teams(teacher_states(law, 5, (Rollouts(3, 5, 2.0), Rollouts(4, 1, 1.0))))
    # Two runs of three robots undisturbed, two a little and one more; one of four robots.
    assert [len(world.poses) for world in made] == [2, 2, 1, 1]
    assert [len(team) for team in states] == [3] * 5 * 5 + [4] * 3
    began = dagger.sample_starts(3, 2, int(np.random.SeedSequence([5, 0, 0]).generate_state(1, np.uint64)[0]))
    seeds = np.random.SeedSequence([5, 0, 1, 3]).spawn(2)
    world = World(began, get_profile("ideal"), seeds=seeds)
    alone = [world.poses[..., :2]]
    for tick in range(20):
        world.apply(Triangulating(law=law).command(world.observe()), 0.1)
        if tick % 5 == 4:
            alone.append(world.poses[..., :2])
    np.testing.assert_array_equal(states[:10], np.stack(alone, axis=1).reshape(10, 3, 2))


def test_teacher_states_are_a_function_of_law_and_seed() -> None:
    law = TriangulatingLaw()
    first, again = teacher_states(law, 1, TEACHER), teacher_states(law, 1, TEACHER)
    np.testing.assert_array_equal(first.positions, again.positions)
    np.testing.assert_array_equal(first.offsets, again.offsets)
    for other in (teacher_states(law, 2, TEACHER), teacher_states(replace(law, gain=1.0), 1, TEACHER)):
        assert not np.array_equal(other.positions, first.positions)


def test_of_later_states_only_a_share_is_kept() -> None:
    states = teacher_states(TriangulatingLaw(), 1, (Rollouts(2, 12, 25.0),))
    # 30 states of each run are early, and 21 late.
    assert 12 * 30 + 40 < len(states) < 12 * 30 + 140


def test_learner_states_hang_on_the_policy_and_the_round() -> None:
    torch.manual_seed(1)
    policies = [VisionTransformer(TINY.network) for _ in range(2)]
    spec = TINY.spec()
    first, again, other = (
        learner_states(policy, spec, 1, 1, LEARNER) for policy in (policies[0], policies[0], policies[1])
    )
    np.testing.assert_array_equal(first.positions, again.positions)
    assert not np.array_equal(first.positions, other.positions)
    # The same starts, and other ways.
    np.testing.assert_array_equal(teams(first)[0], teams(other)[0])
    later = learner_states(policies[0], spec, 1, 2, LEARNER)
    assert not np.array_equal(teams(later)[0], teams(first)[0])
    assert [len(team) for team in teams(first)] == [3] * 5 + [4] * 10


def test_the_learner_drives_in_float32_while_products_are_rounded(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    export = dagger.export_policy

    def watched(*given: Any) -> Any:
        found.append(torch.get_float32_matmul_precision())
        return export(*given)

    monkeypatch.setattr(dagger, "export_policy", watched)
    with matrix_products("medium"):
        learner_states(VisionTransformer(TINY.network), TINY.spec(), 1, 1, LEARNER)
        assert torch.get_float32_matmul_precision() == "medium"
    assert found == ["highest"]


def test_rounds_of_no_steps_do_no_harm(tmp_path: Path) -> None:
    """Of three steps, rounds begin after 0, 2 and 2."""
    config = replace(TINY, maps=60, rounds=(0.1, 0.6, 0.7))
    assert config.round_steps(3) == [0, 0, 2, 2, 3]
    train(config, tmp_path / "whole")
    for step in (1, 2):
        with pytest.raises(KeyboardInterrupt):
            train(config, tmp_path / f"{step}", report=stop_at(step), save_seconds=0.0)
        train(config, tmp_path / f"{step}", resume=True)
        assert results(tmp_path / f"{step}") == results(tmp_path / "whole")


def test_batches_are_functions_of_seed_number_and_states() -> None:
    source = SceneSource(TINY)
    third = [next(source.batches(3))(), list(zip(range(4), source.batches(0), strict=False))[3][1]()]
    np.testing.assert_array_equal(third[0].commands, third[1].commands)
    np.testing.assert_array_equal(third[0].packed.patches, third[1].packed.patches)
    assert third[0].commands.shape == (20, 4)
    assert third[0].features.shape == (20, 5)
    assert not np.array_equal(next(source.batches(4))().commands, third[0].commands)
    source.visited = teacher_states(TriangulatingLaw(), 1, TEACHER)
    assert not np.array_equal(next(source.batches(3))().commands, third[0].commands)


def test_wrong_use_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TriformError, match="'tiny' draws its own scenes; it reads no --data"):
        train(TINY, tmp_path / "run", data=tmp_path)
    with pytest.raises(TriformError, match="neither how many maps"):
        train(replace(TINY, maps=None), tmp_path / "run")
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigurationError, match="only learning from scenes has rounds"):
        replace(TINY, scenes=None, teacher="expert")
    for rounds in ((0.0, 0.5), (0.5, 1.0), (0.5, 0.4), (0.5, 0.5), (float("nan"),)):
        with pytest.raises(ConfigurationError, match="growing shares between 0 and 1"):
            replace(TINY, rounds=rounds)


def test_presets_that_learn_from_scenes_learn_the_whole_law() -> None:
    chosen = [preset for preset in PRESETS.values() if preset.scenes is not None]
    assert chosen
    for preset in chosen:
        assert preset.network.outputs == 4
        assert preset.spec().distances == preset.scenes.distances
        assert (preset.spec().rest_speed, preset.spec().least_push) == (preset.rest_speed, preset.least_push)
