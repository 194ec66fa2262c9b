"""Mini-batches for the loop: drawn afresh or read from a data set, packed in the background."""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from triform.control import Teacher, expert_variant
from triform.dataset import MANIFEST, Demonstrations, Records, Split, draw_fresh, neighbours
from triform.files import sha256
from triform.policy import PackedMaps, pack
from triform.training.auxiliary import token_targets
from triform.training.presets import TrainConfig
from triform.types import FloatArray, MapArray, TriformError

#: Maps of the validation set, about.
VALIDATION_MAPS = 4000
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


def _prepare(
    maps: MapArray, commands: NDArray[np.floating], neighbours_body: FloatArray, config: TrainConfig
) -> TrainBatch:
    patch = config.network.patch
    packed = pack(maps, patch, config.network.attention)
    odd_gain = expert_variant(config.teacher).odd_gain
    targets, valid = token_targets(packed, neighbours_body, config.map, patch, config.distance, odd_gain)
    return TrainBatch(packed, commands.astype(np.float32), targets, valid)


def _validation_count(config: TrainConfig) -> int:
    """Mini-batches of a validation set."""
    return max(1, round(VALIDATION_MAPS / config.batch_maps))


class FreshSource:
    """Demonstrations drawn anew for every mini-batch, each a function of the seed and its number."""

    def __init__(self, config: TrainConfig) -> None:
        """Draw as ``config`` says.

        Raises:
            TriformError: If the configuration wants one epoch, which only a stored data set has.
        """
        if config.maps is None:
            raise TriformError(f"the preset {config.preset!r} trains on stored demonstrations; give them with --data")
        self._config = config
        self._teacher = Teacher(config.teacher, config.distance)
        self.steps = -(-config.maps // config.batch_maps)
        #: Fresh demonstrations need no data set.
        self.checksum: str | None = None

    def batches(self, start: int) -> Iterator[TrainBatch]:
        """Mini-batches from number ``start`` on, without end."""
        return (self._draw(_FRESH_STREAM, index) for index in itertools.count(start))

    def validation(self) -> list[TrainBatch]:
        """Mini-batches that training never draws."""
        return [self._draw(_VALIDATION_STREAM, index) for index in range(_validation_count(self._config))]

    def _draw(self, stream: int, index: int) -> TrainBatch:
        config = self._config
        rng = np.random.default_rng(np.random.SeedSequence([config.seed, stream, index]))
        fresh = draw_fresh(rng, config.batch_maps, self._teacher, config.states, config.scan, config.map)
        return _prepare(fresh.maps, fresh.commands, fresh.neighbours, config)


class StoredSource:
    """Demonstrations read from a data set, epoch after epoch, each in an order of its own."""

    def __init__(self, config: TrainConfig, data: Path) -> None:
        """Read the data set in ``data``.

        Raises:
            TriformError: If it cannot be read, or was collected with another scan, map or distance.
        """
        self._demonstrations = Demonstrations.open(data)
        self._config = config
        self.checksum: str | None = sha256((data / MANIFEST).read_bytes())
        collected = self._demonstrations.manifest.config
        for name in ("scan", "map", "distance"):
            wanted, found = getattr(config, name), getattr(collected, name)
            if wanted != found:
                raise TriformError(f"{data} was collected with {name} {found}; this training wants {wanted}")
        #: Another teacher than that of the data set labels its states anew.
        self._relabel: Teacher | None = None
        if collected.teacher != config.teacher:
            self._relabel = Teacher(config.teacher, config.distance, collected.gain, collected.max_speed)
        self._records = max(1, round(config.batch_maps / collected.robots))
        self._epoch = self._demonstrations.batch_count("train", self._records)
        if self._epoch == 0:
            raise TriformError(f"{data} holds no training records")
        batch_maps = self._records * collected.robots
        self.steps = self._epoch if config.maps is None else -(-config.maps // batch_maps)

    def batches(self, start: int) -> Iterator[TrainBatch]:
        """Mini-batches from number ``start`` on, without end."""
        epoch, begin = divmod(start, self._epoch)
        while True:
            for records in self._demonstrations.batches(
                "train", self._records, seed=self._config.seed, epoch=epoch, start=begin
            ):
                yield self._read(records)
            epoch, begin = epoch + 1, 0

    def validation(self) -> list[TrainBatch]:
        """Some of the records that are held out; of the training records if none are."""
        split: Split = "validation" if self._demonstrations.records("validation") else "train"
        records = self._demonstrations.batches(split, self._records, seed=self._config.seed)
        return [self._read(each) for each in itertools.islice(records, _validation_count(self._config))]

    def _read(self, records: Records) -> TrainBatch:
        around = neighbours(records.poses, expert_variant(self._config.teacher).sensing_range)
        commands: NDArray[np.floating] = records.commands
        if self._relabel is not None:
            commands = self._relabel.label(records.poses).reshape(-1, 3)
        return _prepare(records.maps(), commands, around, self._config)


def open_source(config: TrainConfig, data: Path | None) -> FreshSource | StoredSource:
    """Demonstrations stored in ``data``, or fresh ones if it is ``None``."""
    return FreshSource(config) if data is None else StoredSource(config, data)


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
