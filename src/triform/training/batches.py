"""Mini-batches for the loop: drawn afresh or read from a data set, packed in the background."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triform.control import get_teacher
from triform.dataset.fresh import draw_fresh
from triform.policy import PackedMaps, pack
from triform.training.auxiliary import TARGETS, token_targets
from triform.training.presets import TrainConfig

_QUEUE_LENGTH = 4
_FRESH_STREAM = 0
_VALIDATION_STREAM = 1


@dataclass(frozen=True)
class TrainBatch:
    """A mini-batch of M maps with K tokens.

    Attributes:
        packed: The maps.
        commands: The teacher's body twists [m/s, m/s, rad/s], shape (M, 3).
        targets: Auxiliary targets of the tokens, shape (K, 5).
        valid: Tokens that have targets, shape (K,).
    """

    packed: PackedMaps
    commands: NDArray[np.float32]
    targets: NDArray[np.float32]
    valid: NDArray[np.bool_]


def _fresh(config: TrainConfig, stream: int, index: int, maps: int) -> TrainBatch:
    rng = np.random.default_rng(np.random.SeedSequence([config.seed, stream, index]))
    teacher = get_teacher(config.teacher)
    batch = draw_fresh(rng, maps, teacher, config.states, config.scan, config.map)
    packed = pack(batch.maps, config.network.patch, config.network.attention)
    targets, valid = token_targets(packed, batch.neighbours, config.map, config.network.patch, teacher.distance)
    return TrainBatch(packed, batch.commands.astype(np.float32), targets, valid)


def fresh_batches(config: TrainConfig, start: int) -> Iterator[TrainBatch]:
    """Endless fresh mini-batches from number ``start`` on; each is a function of the seed and its number."""
    index = start
    while True:
        yield _fresh(config, _FRESH_STREAM, index, config.batch_maps)
        index += 1


def validation_batches(config: TrainConfig, maps: int = 4000) -> list[TrainBatch]:
    """A fixed set of about ``maps`` fresh demonstrations that training never draws, in mini-batches."""
    count = max(1, round(maps / config.batch_maps))
    return [_fresh(config, _VALIDATION_STREAM, index, config.batch_maps) for index in range(count)]


class Prefetched:
    """Produces the batches of an iterator in a background thread; use as a context manager and iterate."""

    def __init__(self, batches: Iterator[TrainBatch]) -> None:
        self._batches = batches
        self._queue: queue.Queue[TrainBatch | Exception | None] = queue.Queue(_QUEUE_LENGTH)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._produce, name="batches", daemon=True)

    def _produce(self) -> None:
        try:
            for batch in self._batches:
                if not self._put(batch):
                    return
            self._put(None)
        except Exception as error:  # noqa: BLE001 - whatever it is, the consumer raises it
            self._put(error)

    def _put(self, item: TrainBatch | Exception | None) -> bool:
        while not self._stop.is_set():
            try:
                self._queue.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False

    def __enter__(self) -> Iterator[TrainBatch]:
        self._thread.start()
        return self._consume()

    def _consume(self) -> Iterator[TrainBatch]:
        while (item := self._queue.get()) is not None:
            if isinstance(item, Exception):
                raise item
            yield item

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
