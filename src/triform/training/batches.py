"""Mini-batches for the loop: drawn afresh or read from a data set, and packed."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from triform.control import Teacher
from triform.dataset import (
    COLUMNS,
    MANIFEST,
    Demonstrations,
    FreshBatch,
    Records,
    Split,
    StateBuffer,
    draw_fresh,
    draw_states,
    draw_views,
    label_states,
    neighbours,
)
from triform.files import sha256
from triform.policy import GnnConfig, PackedMaps, RadiusGraph, map_network, pack
from triform.policy.kinds import network_inputs
from triform.policy.network import to_device
from triform.training.auxiliary import edge_targets, token_targets
from triform.training.presets import TrainConfig
from triform.training.processes import ALONE, Processes
from triform.types import FloatArray, MapArray, TriformError

#: Maps of the validation set, about.
VALIDATION_MAPS = 4000
_FRESH_STREAM = 0
_VALIDATION_STREAM = 1
#: Parts of a fresh mini-batch, each drawn from a stream of its own, so that processes can share the drawing.
_PARTS = 8
#: Packed mini-batches are filled up to multiples of these, because matrix products of a size that was met before start
#: at once, whereas a new size has its kernels compiled first.
_TOKEN_STEP = 128
_MAP_STEP = 8


@dataclass(frozen=True)
class TrainBatch:
    """A mini-batch of M maps with K tokens, or the share of it that falls to one process.

    Attributes:
        packed: The maps, and behind them others that only fill up the batch to a size that was met before. For a graph
            network, whole teams instead of maps, edges instead of tokens, and behind the robots that are meant the rest
            of their team.
        commands: What the network is to answer for the maps that are meant, shape (M, outputs).
        targets: Auxiliary targets of the tokens, shape (K, TARGETS).
        valid: Tokens that have targets, shape (K,).
        features: Features of the triangulating law for the maps that are meant, shape (M, LAW_FEATURES), or (M, 0)
            without it.
        maps: Maps of the whole mini-batch.
    """

    packed: PackedMaps | RadiusGraph
    commands: NDArray[np.float32]
    targets: NDArray[np.float32]
    valid: NDArray[np.bool_]
    features: NDArray[np.float32]
    maps: int

    def to(self, device: torch.device) -> DeviceBatch:
        """The mini-batch in PyTorch."""
        arrays = (self.commands, self.targets, self.valid, self.features)
        commands, targets, valid, features = (to_device(array, device) for array in arrays)
        return DeviceBatch(network_inputs(self.packed, device), commands, targets, valid, features)


@dataclass(frozen=True)
class DeviceBatch:
    """A ``TrainBatch`` on the device where it is used; attributes as there, ``inputs`` being what its network reads."""

    inputs: Any
    commands: Tensor
    targets: Tensor
    valid: Tensor
    features: Tensor


def _prepare(
    maps: MapArray,
    commands: NDArray[np.floating],
    seen: FloatArray,
    config: TrainConfig,
    whole: int,
    features: FloatArray | None = None,
) -> TrainBatch:
    network = map_network(config.network)
    patch = network.patch
    packed = pack(maps, patch, network.attention)
    targets, valid = token_targets(packed, seen, config.map, patch)
    if network.attention == "occupied":
        packed = _filled_up(packed)
        missing = len(packed.patches) - len(targets)
        targets, valid = np.pad(targets, ((0, missing), (0, 0))), np.pad(valid, (0, missing))
    told = np.empty((len(commands), 0)) if features is None else features
    return TrainBatch(packed, commands.astype(np.float32), targets, valid, told.astype(np.float32), whole)


def _filled_up(packed: PackedMaps) -> PackedMaps:
    """Append maps of empty patches, between one and two ``_MAP_STEP`` of them, up to the next steps in both sizes."""
    tokens = -len(packed.patches) % _TOKEN_STEP
    maps = _MAP_STEP + -len(packed.counts) % _MAP_STEP
    counts = tokens * np.arange(maps + 1) // maps
    return PackedMaps(
        np.pad(packed.patches, ((0, tokens), (0, 0))),
        np.pad(packed.positions, (0, tokens)),
        np.concatenate([packed.counts, np.diff(counts)]),
    )


def _validation_count(config: TrainConfig) -> int:
    """Mini-batches of a validation set."""
    return max(1, round(VALIDATION_MAPS / config.batch_maps))


class DrawnSource(ABC):
    """Mini-batches drawn anew, each a function of the seed and its number."""

    def __init__(self, config: TrainConfig, maps: int) -> None:
        """Draw ``maps`` maps as ``config`` says."""
        self._config = config
        self.steps = -(-maps // config.batch_maps)
        #: What is drawn needs no data set.
        self.checksum: str | None = None

    def batches(self, start: int, processes: Processes = ALONE) -> Iterator[Callable[[], TrainBatch]]:
        """Tasks that draw the mini-batches from number ``start`` on, or the share of a process in them, without end."""
        return (partial(self._draw, _FRESH_STREAM, index, processes) for index in itertools.count(start))

    def validation(self) -> list[TrainBatch]:
        """Mini-batches that training never draws."""
        return [self._draw(_VALIDATION_STREAM, index, ALONE) for index in range(_validation_count(self._config))]

    @abstractmethod
    def _draw(self, stream: int, index: int, processes: Processes) -> TrainBatch:
        """Draw what of a mini-batch falls to a process."""


class FreshSource(DrawnSource):
    """Demonstrations drawn anew for every mini-batch, each a function of the seed and its number."""

    def __init__(self, config: TrainConfig) -> None:
        """Draw as ``config`` says.

        Raises:
            TriformError: If the configuration wants one epoch, which only a stored data set has.
        """
        if config.maps is None:
            raise TriformError(f"the preset {config.preset!r} trains on stored demonstrations; give them with --data")
        super().__init__(config, config.maps)
        self._teacher = Teacher(config.teacher, config.distance)

    def _draw(self, stream: int, index: int, processes: Processes) -> TrainBatch:
        """Draw the parts of a mini-batch of one team size that fall to a process."""
        config = self._config
        seeds = np.random.SeedSequence([config.seed, stream, index]).spawn(1 + _PARTS)
        robots = int(np.random.default_rng(seeds[0]).choice(np.array(config.states.robots)))
        states = replace(config.states, robots=(robots,))
        records = max(1, round(config.batch_maps / robots))
        first, last = processes.share(_PARTS)
        parts = []
        for part in range(first, last):
            count = records * (part + 1) // _PARTS - records * part // _PARTS
            if count > 0:
                rng = np.random.default_rng(seeds[1 + part])
                parts.append(draw_fresh(rng, count * robots, self._teacher, states, config.scan, config.map))
        if not parts:
            maps = np.empty((0, config.map.size, config.map.size), np.uint8)
            parts.append(FreshBatch(maps, np.empty((0, 3)), np.empty((0, robots - 1, COLUMNS))))
        maps, commands, around = _joined(parts, "maps", "commands", "neighbours")
        return _prepare(maps, commands, around, config, records * robots)


def _joined(parts: Sequence[object], *names: str) -> list[NDArray[Any]]:
    """The arrays of these names of all parts, joined."""
    return [np.concatenate([getattr(part, name) for part in parts]) for name in names]


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
        self._teacher = Teacher(config.teacher, config.distance, collected.gain, collected.max_speed)
        #: Another teacher than that of the data set labels its states anew.
        self._relabel = collected.teacher != config.teacher
        self._records = max(1, round(config.batch_maps / collected.robots))
        self._epoch = self._demonstrations.batch_count("train", self._records)
        if self._epoch == 0:
            raise TriformError(f"{data} holds no training records")
        batch_maps = self._records * collected.robots
        self.steps = self._epoch if config.maps is None else -(-config.maps // batch_maps)

    def batches(self, start: int, processes: Processes = ALONE) -> Iterator[Callable[[], TrainBatch]]:
        """Tasks that make the mini-batches from number ``start`` on, or the share of a process, without end."""
        epoch, begin = divmod(start, self._epoch)
        while True:
            for records in self._demonstrations.batches(
                "train", self._records, seed=self._config.seed, epoch=epoch, start=begin
            ):
                yield partial(self._read, records, processes)
            epoch, begin = epoch + 1, 0

    def validation(self) -> list[TrainBatch]:
        """Some of the records that are held out; of the training records if none are."""
        split: Split = "validation" if self._demonstrations.records("validation") else "train"
        records = self._demonstrations.batches(split, self._records, seed=self._config.seed)
        return [self._read(each, ALONE) for each in itertools.islice(records, _validation_count(self._config))]

    def _read(self, records: Records, processes: Processes) -> TrainBatch:
        whole = len(records) * self._demonstrations.manifest.config.robots
        records = records.part(*processes.share(len(records)))
        around = neighbours(records.poses, self._teacher)
        commands: NDArray[np.floating] = records.commands
        if self._relabel:
            commands = self._teacher.label(records.poses).reshape(-1, 3)
        return _prepare(records.maps(), commands, around, self._config, whole)


class SceneSource(DrawnSource):
    """Views of random robots in random states, labelled by the triangulating law.

    Every mini-batch is a function of the seed, its number and the visited states.
    """

    def __init__(self, config: TrainConfig) -> None:
        """Draw as ``config`` says; until ``visited`` is set, all states are random placements."""
        if config.maps is None or config.scenes is None:
            raise TriformError(f"the preset {config.preset!r} says neither how many maps to draw nor from which scenes")
        super().__init__(config, config.maps)
        self._scenes = config.scenes
        self.visited = StateBuffer.none()

    def _draw(self, stream: int, index: int, processes: Processes) -> TrainBatch:
        config = self._config
        seeds = np.random.SeedSequence([config.seed, stream, index]).spawn(_PARTS)
        first, last = processes.share(_PARTS)
        shares = [
            config.batch_maps * (part + 1) // _PARTS - config.batch_maps * part // _PARTS for part in range(_PARTS)
        ]
        # Of more processes than parts, some draw nothing.
        drawn = [(seeds[part], shares[part]) for part in range(first, last)] or [(seeds[0], 0)]
        parts = [
            draw_views(
                np.random.default_rng(part_seed), share, config.law, self._scenes, self.visited, config.scan, config.map
            )
            for part_seed, share in drawn
        ]
        maps, commands, seen, features = _joined(parts, "maps", "commands", "seen", "features")
        return _prepare(maps, commands, seen, config, config.batch_maps, features)


class TeamSource(SceneSource):
    """Random states of whole teams for a graph network, labelled by the triangulating law.

    Every mini-batch has exactly as many labelled robots as one of ``SceneSource``. Of its last team some may not be
    meant, but all of it is heard.
    """

    def __init__(self, config: TrainConfig, network: GnnConfig) -> None:
        """Draw as ``config`` says for its ``network``."""
        super().__init__(config)
        self._reach = network.reach

    def _draw(self, stream: int, index: int, processes: Processes) -> TrainBatch:
        config = self._config
        rng = np.random.default_rng([config.seed, stream, index])
        whole = draw_states(rng, config.batch_maps, self._scenes, self.visited)
        first, last = processes.share(len(whole))
        states = whole.part(first, last)
        graph = states.graph(self._reach)
        labels = label_states(states, graph, config.law, config.scan.range_max, self._scenes.max_speed)
        targets, valid = edge_targets(labels)
        meant = min(config.batch_maps - int(whole.offsets[first]), len(states.poses))
        commands, features = (values[:meant].astype(np.float32) for values in (labels.commands, labels.features))
        return TrainBatch(graph, commands, targets, valid & (graph.receivers < meant), features, config.batch_maps)


Source = FreshSource | StoredSource | SceneSource


def open_source(config: TrainConfig, data: Path | None) -> Source:
    """Demonstrations stored in ``data``, or fresh ones if it is ``None``: scenes if the configuration has any.

    Raises:
        TriformError: If the data cannot be used, or the configuration needs none.
    """
    if config.scenes is not None:
        if data is not None:
            raise TriformError(f"the preset {config.preset!r} draws its own scenes; it reads no --data")
        network = config.network
        return TeamSource(config, network) if isinstance(network, GnnConfig) else SceneSource(config)
    return FreshSource(config) if data is None else StoredSource(config, data)
