from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.dataset import StateBuffer, joined
from triform.types import ConfigurationError, TriformError


def random_states(seed: int) -> StateBuffer:
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 9, rng.integers(0, 6))
    # Numbers that a file keeps.
    positions = rng.normal(0, 3, (sizes.sum(), 2)).astype(np.float32).astype(np.float64)
    return StateBuffer(positions, np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64))


def listed(states: StateBuffer) -> list[bytes]:
    return [states.positions[a:b].tobytes() for a, b in zip(states.offsets[:-1], states.offsets[1:], strict=True)]


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_saved_states_come_back(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    path = tmp_path_factory.getbasetemp() / "states.npz"
    states = random_states(seed)
    states.save(path)
    back = StateBuffer.load(path)
    np.testing.assert_array_equal(back.positions, states.positions)
    np.testing.assert_array_equal(back.offsets, states.offsets)
    assert (back.positions.dtype, back.offsets.dtype) == (np.float64, np.int64)
    assert sorted(path.parent.glob("*states*")) == [path]


@settings(deadline=None, max_examples=60)
@given(st.lists(st.integers(0, 2**32 - 1), max_size=5))
def test_joined_states_stand_one_behind_the_other(seeds: list[int]) -> None:
    parts = [random_states(seed) for seed in seeds]
    whole = joined(parts)
    assert len(whole) == sum(len(part) for part in parts)
    assert listed(whole) == [state for part in parts for state in listed(part)]
    assert whole.offsets.dtype == np.int64


def test_states_of_teams_of_one_size() -> None:
    teams = np.random.default_rng(1).normal(size=(5, 3, 2))
    states = StateBuffer.of_teams(teams)
    assert listed(states) == [team.tobytes() for team in teams]
    assert len(StateBuffer.of_teams(teams[:0])) == len(StateBuffer.none()) == len(joined([])) == 0


@pytest.mark.parametrize(
    ("positions", "offsets", "says"),
    [
        (np.zeros((3, 3)), [0, 3], r"shape \(K, 2\)"),
        (np.zeros(6), [0, 6], r"shape \(K, 2\)"),
        (np.array([[0.0, np.nan]]), [0, 1], "finite"),
        (np.array([[0.0, np.inf]]), [0, 1], "finite"),
        (np.zeros((3, 2)), [0, 2], "offsets"),
        (np.zeros((3, 2)), [1, 3], "offsets"),
        (np.zeros((3, 2)), [0, 2, 2, 3], "offsets"),
        (np.zeros((3, 2)), [0, 4, 3], "offsets"),
        (np.zeros((3, 2)), [], "offsets"),
        (np.zeros((0, 2)), [[0, 0]], "offsets"),
    ],
)
def test_what_are_no_states_is_refused(positions: np.ndarray, offsets: list, says: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=says):
        StateBuffer(positions, np.array(offsets, dtype=np.int64))
    path = tmp_path / "states.npz"
    np.savez(path, positions=positions, offsets=np.array(offsets, dtype=np.int64))
    with pytest.raises(TriformError, match=f"holds no visited states: .*{says}"):
        StateBuffer.load(path)


def test_a_foreign_or_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "states.npz"
    with pytest.raises(TriformError, match="holds no visited states"):
        StateBuffer.load(path)
    random_states(3).save(path)
    whole = path.read_bytes()
    for data in (b"", b"nonsense", whole[:4], whole[:40], whole[:-10]):
        path.write_bytes(data)
        with pytest.raises(TriformError, match="holds no visited states"):
            StateBuffer.load(path)
    np.savez(path, positions=np.zeros((1, 2)))
    with pytest.raises(TriformError, match="holds no visited states"):
        StateBuffer.load(path)
    np.savez(path, positions=np.array([{}], dtype=object), offsets=np.zeros(1, dtype=np.int64))
    with pytest.raises(TriformError, match="holds no visited states"):
        StateBuffer.load(path)
    with path.open("wb") as file:
        np.save(file, np.zeros((1, 2)))
    with pytest.raises(TriformError, match="holds no visited states"):
        StateBuffer.load(path)


def test_no_flipped_bit_changes_a_state(tmp_path: Path) -> None:
    path, states = tmp_path / "states.npz", random_states(5)
    states.save(path)
    whole = path.read_bytes()
    refused = 0
    for place in range(len(whole)):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << place % 8
        path.write_bytes(flipped)
        try:
            back = StateBuffer.load(path)
        except TriformError:
            refused += 1
        else:
            assert listed(back) == listed(states)
    assert refused > len(whole) / 2


def test_a_folder_that_is_missing_is_no_place_to_save(tmp_path: Path) -> None:
    with pytest.raises(TriformError):
        StateBuffer.none().save(tmp_path / "file.npz" / "states.npz")
