from __future__ import annotations

import threading
from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.dataset import Demonstrations, Records
from triform.types import ConfigurationError

from .conftest import SMALL
from .test_contents import maps_of
from .test_records import assert_same


def keys(batches: list[Records]) -> list[tuple[int, int]]:
    return [(int(run), int(step)) for batch in batches for run, step in zip(batch.run, batch.step, strict=True)]


def test_an_epoch_holds_every_record_of_its_split_once(small: Demonstrations) -> None:
    held_out = set(SMALL.validation_runs().tolist())
    seen = {split: keys(list(small.batches(split, 16, pool_records=50))) for split in ("train", "validation")}  # type: ignore[arg-type]
    for split, found in seen.items():
        assert len(set(found)) == len(found) == small.records(split)  # type: ignore[arg-type]
        assert all((run in held_out) == (split == "validation") for run, _ in found)
    assert sum(map(len, seen.values())) == SMALL.records


@pytest.mark.parametrize("shuffle", [True, False])
def test_batches_pair_maps_with_their_poses_and_commands(small: Demonstrations, shuffle: bool) -> None:
    original = {
        key: (pose, command)
        for batch in small.batches("train", 1, shuffle=False)
        for key, pose, command in zip(keys([batch]), batch.poses, [batch.commands], strict=True)
    }
    for batch in small.batches("train", 7, shuffle=shuffle, pool_records=40):
        np.testing.assert_array_equal(batch.maps(), maps_of(batch.poses, SMALL.footprint, SMALL.scan, SMALL.map))
        for b, key in enumerate(keys([batch])):
            pose, command = original[key]
            np.testing.assert_array_equal(batch.poses[b], pose)
            np.testing.assert_array_equal(batch.commands[b * SMALL.robots : (b + 1) * SMALL.robots], command)


@settings(deadline=None, max_examples=25)
@given(
    batch_records=st.integers(1, 120),
    pool_records=st.integers(1, 500),
    share=st.floats(0, 1),
    epoch=st.integers(0, 3),
    shuffle=st.booleans(),
)
def test_starting_at_a_batch_continues_the_epoch_exactly(
    small_folder, batch_records: int, pool_records: int, share: float, epoch: int, shuffle: bool
) -> None:
    small = Demonstrations.open(small_folder)
    arguments = {
        "split": "train",
        "batch_records": batch_records,
        "seed": 4,
        "epoch": epoch,
        "shuffle": shuffle,
        "pool_records": pool_records,
    }
    whole = list(small.batches(**arguments))  # type: ignore[arg-type]
    assert len(whole) == small.batch_count("train", batch_records)
    assert all(len(batch) == batch_records for batch in whole[:-1])
    start = round(share * len(whole))
    rest = list(small.batches(**arguments, start=start))  # type: ignore[arg-type]
    assert len(rest) == len(whole) - start
    for left, right in zip(whole[start:], rest, strict=True):
        assert_same(left, right)


def test_the_order_is_decided_by_seed_and_epoch(small: Demonstrations) -> None:
    orders = [
        keys(list(small.batches("train", 16, seed=seed, epoch=epoch)))
        for seed, epoch in ((0, 0), (0, 0), (0, 1), (1, 0))
    ]
    assert orders[0] == orders[1]
    assert orders[0] != orders[2] != orders[3] != orders[0]
    assert sorted(orders[0]) == sorted(orders[2])


def test_shuffling_mixes_runs_and_not_shuffling_keeps_the_order(small: Demonstrations) -> None:
    first = next(small.batches("train", 64))
    assert len(set(first.run)) > 5
    in_order = keys(list(small.batches("train", 64, shuffle=False, pool_records=30)))
    assert in_order == sorted(in_order)


def test_leaving_the_stream_early_ends_its_thread(small: Demonstrations) -> None:
    stream = small.batches("train", 8, pool_records=20)
    assert len(list(islice(stream, 3))) == 3
    stream.close()  # type: ignore[attr-defined]
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("read")]


@pytest.mark.parametrize(
    "arguments",
    [
        {"split": "test"},
        {"batch_records": 0},
        {"pool_records": 0},
        {"seed": -1},
        {"start": -1},
        {"start": 10_000},
    ],
)
def test_bad_arguments_are_refused_at_once(small: Demonstrations, arguments: dict[str, object]) -> None:
    with pytest.raises(ConfigurationError):
        small.batches(**({"split": "train", "batch_records": 16} | arguments))  # type: ignore[arg-type]
