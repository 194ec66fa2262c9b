from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.dataset import Records
from triform.dataset.records import concatenate


def random_records(count: int, robots: int, size: int, seed: int) -> tuple[Records, np.ndarray]:
    """Records and the dense maps they were made from."""
    rng = np.random.default_rng(np.random.SeedSequence([count, robots, size, seed]))
    dense = (rng.random((count * robots, size, size)) < 0.2 * rng.random((count * robots, 1, 1))).astype(np.uint8)
    lists = [np.flatnonzero(each).astype(np.int16) for each in dense]
    records = Records(
        run=rng.integers(0, 9, count).astype(np.int32),
        step=np.arange(count, dtype=np.int32),
        poses=rng.random((count, robots, 3)),
        commands=rng.random((count * robots, 3)).astype(np.float32),
        cells=np.concatenate([np.zeros(0, np.int16), *lists]),
        offsets=np.cumsum([0, *(len(each) for each in lists)]).astype(np.int64),
        map_size=size,
    )
    return records, dense


def assert_same(left: Records, right: Records) -> None:
    for name in ("run", "step", "poses", "commands", "cells", "offsets"):
        a, b = getattr(left, name), getattr(right, name)
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b, err_msg=name)
    assert left.map_size == right.map_size


@settings(deadline=None, max_examples=30)
@given(
    count=st.integers(0, 6),
    robots=st.integers(1, 3),
    size=st.integers(1, 9),
    seed=st.integers(0, 99),
    data=st.data(),
)
def test_taking_parts_and_joining_agree_with_dense_maps(
    count: int, robots: int, size: int, seed: int, data: st.DataObject
) -> None:
    records, dense = random_records(count, robots, size, seed)
    np.testing.assert_array_equal(records.maps(), dense)

    by_record = dense.reshape(count, robots, size, size)
    if count:
        order = np.array(data.draw(st.lists(st.integers(0, count - 1))), dtype=np.int64)
        taken = records.take(order)
        np.testing.assert_array_equal(taken.maps(), by_record[order].reshape(-1, size, size))
        np.testing.assert_array_equal(taken.commands, records.commands.reshape(count, robots, 3)[order].reshape(-1, 3))
        np.testing.assert_array_equal(taken.poses, records.poses[order])

    cut = data.draw(st.integers(0, count))
    left, right = records.part(0, cut), records.part(cut, count)
    np.testing.assert_array_equal(right.maps(), by_record[cut:].reshape(-1, size, size))
    assert len(left) == cut
    assert_same(concatenate([left, right]), records)


def test_a_map_with_every_cell_occupied() -> None:
    cells = np.arange(9, dtype=np.int16)
    records = Records(
        run=np.zeros(1, np.int32),
        step=np.zeros(1, np.int32),
        poses=np.zeros((1, 1, 3)),
        commands=np.zeros((1, 3), np.float32),
        cells=cells,
        offsets=np.array([0, 9]),
        map_size=3,
    )
    assert records.maps().all()
