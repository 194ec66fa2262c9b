"""Properties of starts and of the files they are read from."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform
from scipy.stats import kstest

from triform.simulation import is_connected, load_starts, sample_addition, sample_starts
from triform.simulation.spawning import square_side
from triform.types import ConfigurationError, TriformError

Array = NDArray[np.float64]


@pytest.mark.parametrize(("robots", "side"), [(1, 5), (2, 5), (4, 4), (7, 5), (13, 5), (20, 6.2018), (30, 7.5955)])
def test_starts_keep_the_protocol(robots: int, side: float) -> None:
    poses = sample_starts(robots, 40, 7)
    assert poses.shape == (40, robots, 3)
    assert square_side(robots) == pytest.approx(side, abs=1e-4)
    assert np.abs(poses[..., :2]).max() <= side / 2 + 1e-4
    assert np.all((poses[..., 2] >= -np.pi) & (poses[..., 2] < np.pi))
    for start in poses:
        distances = pdist(start[:, :2])
        assert distances.min(initial=np.inf) >= 0.5
        assert connected_components(squareform(distances) <= 2.0)[0] == 1


def test_a_start_depends_on_robots_seed_and_index_alone() -> None:
    whole = sample_starts(6, 10, 3)
    np.testing.assert_array_equal(sample_starts(6, 4, 3, first=5), whole[5:9])
    assert not np.array_equal(sample_starts(6, 10, 4), whole)
    assert len(np.unique(whole[:, 0, 0])) == 10


def test_large_teams_can_start() -> None:
    poses = sample_starts(200, 1, 1)[0]
    assert pdist(poses[:, :2]).min() >= 0.5
    # They fill the square evenly: quarters hold about 50 each.
    quarters = np.histogram2d(poses[:, 0], poses[:, 1], bins=2)[0]
    assert quarters.min() > 30


#: Digests of starts drawn before large teams were placed by cells; a start never changes.
@pytest.mark.parametrize(
    ("robots", "digest"),
    [(5, "7164c18a7008"), (13, "eb25a6ee6ba2"), (25, "f3297ad72136"), (100, "76ab035b1d0c"), (900, "7b14bbd38b06")],
)
def test_starts_are_what_they_always_were(robots: int, digest: str) -> None:
    assert hashlib.sha256(sample_starts(robots, 2, 7).tobytes()).hexdigest()[:12] == digest


@pytest.mark.parametrize("robots", [1001, 5000])
def test_very_large_teams_keep_the_protocol_too(robots: int) -> None:
    poses = sample_starts(robots, 1, 3)[0]
    tree = cKDTree(poses[:, :2])
    assert not tree.query_pairs(np.nextafter(0.5, 0))
    pairs = tree.query_pairs(2.0, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), (robots, robots))
    assert connected_components(links, directed=False)[0] == 1
    half = square_side(robots) / 2
    assert np.abs(poses[:, :2]).max() <= half
    for axis in range(2):
        assert kstest(poses[:, axis], "uniform", (-half, 2 * half)).pvalue > 1e-3
    np.testing.assert_array_equal(sample_starts(robots, 2, 3)[0], poses)


def test_a_large_team_in_a_wide_square_is_linked_all_the_same() -> None:
    poses = sample_starts(1100, 1, 1, side=120.0)[0]
    assert is_connected(np.ascontiguousarray(poses[:, :2]), 2.0)


@pytest.mark.parametrize("distance", [0.6, 0.8, 1.25, 1.5])
@pytest.mark.parametrize("robots", [4, 7, 13, 20, 50])
def test_starts_grow_with_the_prescribed_distance(robots: int, distance: float) -> None:
    poses = sample_starts(robots, 20, 7, distance=distance)
    assert square_side(robots, distance) == pytest.approx(distance * square_side(robots))
    assert np.abs(poses[..., :2]).max() <= square_side(robots, distance) / 2
    for start in poses:
        distances = pdist(start[:, :2])
        assert distances.min() >= max(0.5, 0.5 * distance)
        assert connected_components(squareform(distances) <= 2.0 * distance)[0] == 1
    np.testing.assert_array_equal(sample_starts(robots, 1, 7, first=3, distance=distance)[0], poses[3])


def test_a_scaled_start_is_the_same_start_scaled() -> None:
    np.testing.assert_array_equal(sample_starts(7, 5, 7, distance=1.0), sample_starts(7, 5, 7))
    np.testing.assert_allclose(sample_starts(7, 5, 7, distance=1.5)[..., :2], 1.5 * sample_starts(7, 5, 7)[..., :2])


def test_the_square_of_small_distances_keeps_room_for_the_robots() -> None:
    assert square_side(13, 0.6) == pytest.approx(3.0)
    assert square_side(13, 0.5) == square_side(13, 0.6)
    assert pdist(sample_starts(7, 1, 1, distance=0.5)[0, :, :2]).min() >= 0.5


def test_a_single_robot_is_uniform() -> None:
    poses = sample_starts(1, 2000, 5)[:, 0]
    for values, half in [(poses[:, 0], 2.5), (poses[:, 1], 2.5), (poses[:, 2], np.pi)]:
        assert kstest(values, "uniform", (-half, 2 * half)).pvalue > 1e-3


@pytest.mark.parametrize(("robots", "runs", "seed", "side"), [(0, 1, 1, None), (2, -1, 1, None), (2, 1, -1, None)])
def test_impossible_requests_are_refused(robots: int, runs: int, seed: int, side: float | None) -> None:
    with pytest.raises(ConfigurationError):
        sample_starts(robots, runs, seed, side=side)


def test_a_square_without_room_is_refused() -> None:
    with pytest.raises(TriformError, match="no start of 9 robots"):
        sample_starts(9, 1, 1, side=0.6)
    with pytest.raises(ConfigurationError, match="side"):
        sample_starts(9, 1, 1, side=0.0)
    with pytest.raises(ConfigurationError, match="distance"):
        sample_starts(9, 1, 1, distance=0.0)


def test_additions_are_near_but_not_too_near() -> None:
    rng = np.random.default_rng(2)
    poses = sample_starts(7, 1, 2)[0]
    active = np.array([True] * 6 + [False])
    places = np.array([sample_addition(poses, active, rng) for _ in range(300)])
    nearest = np.linalg.norm(places[:, None, :2] - poses[None, :6, :2], axis=-1).min(axis=1)
    assert nearest.min() >= 0.5
    assert nearest.max() <= 2.0
    with pytest.raises(TriformError, match="no robots"):
        sample_addition(poses, np.zeros(7, dtype=bool), rng)


def test_additions_are_uniform_in_area() -> None:
    rng = np.random.default_rng(3)
    active = np.ones(1, dtype=bool)
    radii = [np.hypot(*sample_addition(np.zeros((1, 3)), active, rng)[:2]) for _ in range(1500)]
    share = (np.square(radii) - 0.25) / (4 - 0.25)
    assert kstest(share, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("distance", [0.6, 1.5])
def test_additions_keep_the_prescribed_distance_too(distance: float) -> None:
    rng = np.random.default_rng(4)
    poses = sample_starts(5, 1, 2, distance=distance)[0]
    places = np.array([sample_addition(poses, np.ones(5, dtype=bool), rng, distance) for _ in range(200)])
    nearest = np.linalg.norm(places[:, None, :2] - poses[None, :, :2], axis=-1).min(axis=1)
    assert nearest.min() >= max(0.5, 0.5 * distance)
    assert 1.5 * distance < nearest.max() <= 2 * distance


ROWS = np.array([[4, 1, 1.0, 2.0, 0.5], [4, 0, 0.0, 0.0, 0.0], [2, 0, 3.0, 3.0, -1.0]])


def test_starts_are_read_from_npy_and_csv(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", ROWS)
    lines = [",".join(map(str, row)) for row in ROWS]
    (tmp_path / "b.csv").write_text("\n".join(lines))
    (tmp_path / "c.csv").write_text("run, robot,x,y,heading\n\n" + "\n".join(lines) + "\n")
    for name in ("a.npy", "b.csv", "c.csv"):
        runs = load_starts(tmp_path / name)
        np.testing.assert_array_equal(runs[0], ROWS[2:, 2:])
        np.testing.assert_array_equal(runs[1], ROWS[[1, 0], 2:])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,0,1,2", "line 1: 4 columns"),
        ("run,robot,x,y,heading\n0,0,1,2,east", "line 2, column heading: 'east' is not a number"),
        ("0,0,1,nan,0", "row 1, column y: nan is not a finite number"),
        ("0,0,inf,0,0", "row 1, column x: inf is not a finite number"),
        ("0,0.5,1,1,0", "row 1, column robot: 0.5 is not a whole number from 0"),
        ("-1,0,1,1,0", "row 1, column run: -1.0 is not a whole number from 0"),
        ("0,0,1,1,0\n0,2,1,1,0", r"run 0, column robot: robots \[0, 2\] given; 0 to 1"),
        ("0,0,1,1,0\n0,0,1,1,0", r"run 0, column robot: robots \[0, 0\] given; 0 to 1"),
        ("", "holds no starts"),
        ("run,robot,x,y,heading\n", "holds no starts"),
    ],
)
def test_malformed_csv_is_refused_by_row_and_column(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "starts.csv"
    path.write_text(text)
    with pytest.raises(TriformError, match=message):
        load_starts(path)


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TriformError, match="cannot be read"):
        load_starts(tmp_path / "missing.csv")
    with pytest.raises(TriformError, match=r"\.npy or \.csv"):
        load_starts(tmp_path / "starts.txt")
    (tmp_path / "text.npy").write_text("not numpy")
    with pytest.raises(TriformError, match=r"not an \.npy file of numbers"):
        load_starts(tmp_path / "text.npy")
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(TriformError, match=r"not an \.npy file of numbers"):
        load_starts(tmp_path / "objects.npy")
    np.save(tmp_path / "flat.npy", np.zeros(5))
    with pytest.raises(TriformError, match="of shape"):
        load_starts(tmp_path / "flat.npy")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(TriformError, match="cannot be read"):
        load_starts(tmp_path / "binary.csv")
