"""Recorded scans: read as they were written, and how bright their returns are."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from triform.commands.show import Show
from triform.robots.scan_file import DISTANCES, read_scans, scan_columns
from triform.types import TriformError


def write(folder: Path, rows: np.ndarray, columns: tuple[str, ...]) -> None:
    folder.mkdir(exist_ok=True)
    lines = [",".join(columns), *(",".join(f"{each:.4f}" for each in row) for row in rows)]
    (folder / "scans.csv").write_text("\n".join(lines) + "\n")


def test_intensities_are_summed_up_by_distance(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    ranges = rng.uniform(0.1, 6.0, (40, 30)).round(4)
    ranges[rng.random(ranges.shape) < 0.3] = np.inf
    ranges[rng.random(ranges.shape) < 0.1] = np.nan
    levels = rng.integers(0, 256, ranges.shape).astype(float)
    write(tmp_path, np.hstack([np.arange(80.0).reshape(40, 2), ranges, levels]), scan_columns(30))
    found = read_scans(tmp_path)
    np.testing.assert_array_equal(found.ranges, ranges)
    np.testing.assert_array_equal(found.intensities, levels)
    np.testing.assert_array_equal(found.started, np.arange(0, 80, 2))
    edges = (*DISTANCES, np.inf)
    summary = found.summarise([0.0, 0.5, 1.0])
    assert len(summary) == len(DISTANCES)
    for (begin, count, shown), low, high in zip(summary, edges[:-1], edges[1:], strict=True):
        mine = levels[(ranges >= low) & (ranges < high)]
        assert (begin, count) == (low, len(mine))
        np.testing.assert_allclose(shown, [mine.min(), np.median(mine), mine.max()])
    out = io.StringIO()
    Show("intensities", str(tmp_path)).run(Console(file=out, width=100))
    assert f"{summary[-1][1]:,}" in out.getvalue()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("", "has other columns than the scans of a recording"),
        ("started,ended,range_0\n1,2,3\n", "has other columns"),
        ("started,ended,range_0,intensity_0\n", "holds no scan"),
        ("started,ended,range_0,intensity_0\n1,2,3,x\n", "holds something else than rows of numbers"),
        ("started,ended,range_0,intensity_0\n1,2,3,4\n1,2\n", "holds something else than rows of numbers"),
        ("started,ended,range_0,intensity_0\n1,2,3", "holds no scan"),
        ("started,ended,range_0,intensity_0\n1,2,3\n", "has 3 numbers in a row under 4 columns"),
    ],
)
def test_other_files_are_refused_in_one_sentence(content: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "scans.csv").write_text(content)
    with pytest.raises(TriformError, match=f"^[^\n]*scans.csv {says}[^\n]*$"):
        read_scans(tmp_path)


def test_returns_without_intensities_are_none_to_show(tmp_path: Path) -> None:
    write(tmp_path, np.array([[0.0, 0.1, 1.0, np.nan], [0.1, 0.2, 1.0, np.inf]]), scan_columns(1))
    with pytest.raises(TriformError, match="have no returns whose intensity is known"):
        Show("intensities", str(tmp_path)).run(Console(file=io.StringIO()))


def test_half_a_last_line_costs_its_scan_alone(tmp_path: Path) -> None:
    write(tmp_path, np.arange(8.0).reshape(2, 4), scan_columns(1))
    path = tmp_path / "scans.csv"
    path.write_text(path.read_text() + "8.0,9.0,1")
    np.testing.assert_array_equal(read_scans(tmp_path).ranges, [[2.0], [6.0]])
