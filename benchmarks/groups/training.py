"""Maps per second while training, as ``triform train`` runs, beside the loop on the dense network."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from benchmarks.peers.dense import DenseTransformer, all_patches
from benchmarks.report import Aim, Row
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Spread
from triform.control import Teacher
from triform.dataset import draw_fresh
from triform.policy import vit_network
from triform.threads import limit_threads
from triform.training import PRESETS, Precision, Progress, TrainConfig, train
from triform.training.precision import matrix_products
from triform.types import FloatArray


class _EnoughError(Exception):
    """Raised from the loop's report to end it."""


def measure(settings: Settings, watch: Watch) -> Iterator[Row]:
    """The paper's network packed and dense in turns, on one thread; the small one on all cores."""
    yield from _against_dense(settings, watch)
    yield _small(settings, watch)


def _against_dense(settings: Settings, watch: Watch) -> Iterator[Row]:
    config = PRESETS["large"]
    what = "training the paper's network, 1 thread, maps/s against the dense loop"
    step, steps = _dense_step(config), 1 if settings.quick else 3
    rates: dict[str, list[float]] = {name: [] for name in ("packed", "dense, float32", f"dense, {config.precision}")}
    packed, dense, same = rates.values()
    for turn in range(settings.training_rounds):
        watch(what, turn, settings.training_rounds)
        packed.append(_rate(config, settings, settings.training_steps, threads=1))
        dense.append(_dense_rate(step, "float32", steps))
        same.append(_dense_rate(step, config.precision, steps))
    note = (
        f"{config.batch_maps} maps a step. Packed is the loop of `triform train --preset large` with an auxiliary loss "
        "and its maps drawn beside it; dense is forward, loss, backward and AdamW in PyTorch with given maps."
    )
    for other, peer, aim in (
        ("PyTorch's own arithmetic", "dense, float32", Aim(">=", 14.0)),
        (f"the same arithmetic ({config.precision})", f"dense, {config.precision}", None),
    ):
        sides = {name: Spread.of(np.array(rates[name]), "maps/s") for name in ("packed", peer)}
        ratio = np.array(packed) / np.array(rates[peer])
        yield Row(f"{what} in {other}", Spread.of(ratio, "x"), aim, sides, note)


def _small(settings: Settings, watch: Watch) -> Row:
    config = PRESETS["springs"]
    what = f"training the small default network, {settings.cores} cores, maps/s"
    rounds = settings.training_rounds
    rates = np.empty(rounds)
    for turn in range(rounds):
        watch(what, turn, rounds)
        rates[turn] = _rate(config, settings, 5 * settings.training_steps, settings.cores)
    drawing = Spread.of(_drawing_rate(config, rounds, settings.training_steps), "maps/s")
    return Row(
        what,
        Spread.of(rates, "maps/s"),
        Aim(">=", 15_000),
        {"drawing maps, 1 thread": drawing},
        "The loop of `triform train --preset default`: one thread for the network and one that "
        "draws and packs maps. Bound by the number of small operations: a step has some 400 of them for 112 maps.",
    )


def _rate(config: TrainConfig, settings: Settings, steps: int, threads: int) -> float:
    """Maps per second of the training loop over ``steps`` steps after its warm-up.

    PyTorch has one thread, attention up to ``threads``, and one more draws and packs maps.
    """
    warm_up = settings.training_warm_up
    marks: list[tuple[float, int]] = []

    def report(at: Progress) -> None:
        if at.step >= warm_up:
            marks.append((time.perf_counter(), at.maps))
        if at.step == warm_up + steps:
            raise _EnoughError

    torch.set_num_threads(1)
    with TemporaryDirectory() as folder, limit_threads(threads), contextlib.suppress(_EnoughError):
        train(config, Path(folder) / "run", report=report)
    (began, first), (ended, last) = marks[0], marks[-1]
    return (last - first) / (ended - began)


def _dense_step(config: TrainConfig) -> Callable[[], int]:
    """One step of training a dense network; returns the number of its maps."""
    torch.manual_seed(config.seed)
    shape = vit_network(config.network)
    network = DenseTransformer(shape)
    optimizer = torch.optim.AdamW(
        network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, fused=True
    )
    rng = np.random.default_rng(config.seed)
    fresh = draw_fresh(rng, config.batch_maps, Teacher(config.teacher), config.states, config.scan, config.map)
    patches = torch.from_numpy(all_patches(fresh.maps, shape.patch))
    wanted = torch.from_numpy(fresh.commands).float()

    def step() -> int:
        torch.set_num_threads(1)
        loss = ((network(patches) - wanted).square().sum(1) + 1e-8).sqrt().mean()
        optimizer.zero_grad()
        torch.autograd.backward(loss)
        torch.nn.utils.clip_grad_norm_(network.parameters(), config.clip)
        optimizer.step()
        return len(wanted)

    return step


def _dense_rate(step: Callable[[], int], precision: Precision, steps: int) -> float:
    with matrix_products(precision):
        step()
        began = time.perf_counter()
        maps = sum(step() for _ in range(steps))
        return maps / (time.perf_counter() - began)


def _drawing_rate(config: TrainConfig, rounds: int, batches: int) -> FloatArray:
    """Fresh maps per second of one thread."""
    rng = np.random.default_rng(0)
    teacher = Teacher(config.teacher)
    rates = np.empty(rounds)
    for turn in range(rounds):
        began = time.perf_counter()
        maps = sum(
            len(draw_fresh(rng, config.batch_maps, teacher, config.states, config.scan, config.map).commands)
            for _ in range(batches)
        )
        rates[turn] = maps / (time.perf_counter() - began)
    return rates
