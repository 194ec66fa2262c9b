"""Campaign: damaged recordings of every format give a right answer or one sentence, never a traceback.

    python -m tests.fuzz.recordings --seconds 60 --seed 0

A recording is damaged at random: bits, bytes, lines and cells change, go, come twice or move, numbers become absurd.
What is still read has to be a trajectory that can be measured.
"""

from __future__ import annotations

import argparse
import io
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from triform.evaluation import Trajectory
from triform.evaluation.metrics import measure
from triform.recordings.description import RunSetting
from triform.recordings.kept import keep_runs
from triform.recordings.resample import read_recordings
from triform.simulation import Arena, Footprint
from triform.types import TriformError

_ABSURD = [
    b"",
    b"nan",
    b"inf",
    b"-inf",
    b"1e308",
    b"-1e308",
    b"1e-308",
    b"999999999999",
    b"0",
    b"-1",
    b"x",
    b"\xff",
    b"\x1b[2J",
]
_SEPARATORS = [b";", b"\t", b" ", b"\r", b'"', b"\0", b"\xef\xbb\xbf"]


def _poses(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Times and poses of three robots on their way, shapes (T,) and (T, 3, 3)."""
    moments = np.arange(0, 6.01, 0.125)
    places = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 0.9]]) + rng.normal(0, 0.05, (3, 2))
    poses = np.zeros((len(moments), 3, 3))
    poses[..., :2] = places * (1 + 0.5 * np.exp(-moments))[:, None, None]
    poses[..., 2] = rng.uniform(-3, 3, 3)
    return moments, poses


def _table(rng: np.random.Generator) -> dict[str, np.ndarray]:
    moments, poses = _poses(rng)
    columns = {"time": np.repeat(moments, 3), "robot": np.tile(np.arange(3), len(moments))}
    return columns | {name: poses[..., k].ravel() for k, name in enumerate(("x", "y", "heading"))}


def csv_file(rng: np.random.Generator) -> bytes:
    """A table of poses as CSV."""
    table = _table(rng)
    rows = zip(*table.values(), strict=True)
    return "\n".join([",".join(table), *(f"{t:g},{r},{x:.4f},{y:.4f},{h:.4f}" for t, r, x, y, h in rows), ""]).encode()


def parquet_file(rng: np.random.Generator) -> bytes:
    """A table of poses as Parquet."""
    sink = io.BytesIO()
    parquet.write_table(pa.table(_table(rng)), sink, compression=str(rng.choice(["none", "snappy"])))
    return sink.getvalue()


def array_file(rng: np.random.Generator) -> bytes:
    """An array of poses."""
    sink = io.BytesIO()
    np.save(sink, _poses(rng)[1])
    return sink.getvalue()


def motive_file(rng: np.random.Generator) -> bytes:
    """An export of Motive with quaternions or Euler angles."""
    moments, poses = _poses(rng)
    rotation = str(rng.choice(["Quaternion", "XYZ"]))
    axes = "XYZW" if rotation == "Quaternion" else "XYZ"
    heads = [["", "Type"], ["", "Name"], ["", "ID"], ["", ""], ["Frame", "Time (Seconds)"]]
    for robot in range(3):
        for part, names in (("Rotation", axes), ("Position", "XYZ")):
            for axis in names:
                for head, cell in zip(heads, ("Rigid Body", f"ep {robot}", "6F", part, axis), strict=True):
                    head.append(cell)
    first = (
        "Format Version,1.23,Take Name,take,Export Frame Rate,8.000000,"
        f"Rotation Type,{rotation},Length Units,Meters,Coordinate Space,Global"
    )
    lines = [first, "", *map(",".join, heads)]
    for frame, (moment, record) in enumerate(zip(moments, poses, strict=True)):
        cells = [str(frame), f"{moment:.6f}"]
        for x, y, heading in record:
            turn = [0, np.sin(heading / 2), 0, np.cos(heading / 2)] if len(axes) == 4 else [0, np.degrees(heading), 0]
            cells += [f"{number:.6f}" for number in (*turn, y, 0.15, x)]
        lines.append(",".join(cells))
    return "\r\n".join([*lines, ""]).encode()


def _kept(rng: np.random.Generator, ending: str) -> bytes:
    """A kept run."""
    moments, poses = _poses(rng)
    run = Trajectory(
        moments, poses[None], np.ones((1, *poses.shape[:2]), np.bool_), np.zeros((1, len(poses) - 1, 3, 3))
    )
    contacts = {"min_distance": np.ones(1), "collision": np.zeros(1, np.bool_), "hit_arena": np.zeros(1, np.bool_)}
    with tempfile.TemporaryDirectory() as name:
        path = Path(name, f"run{ending}")
        with keep_runs(path) as writer:
            writer.add(run, RunSetting(1.0, Footprint.circle(0.3), Arena.room(6.0, 6.0)), contacts)
        return path.read_bytes()


def kept_file(rng: np.random.Generator) -> bytes:
    """A kept run as Parquet."""
    return _kept(rng, ".parquet")


def mcap_file(rng: np.random.Generator) -> bytes:
    """A kept run as MCAP."""
    return _kept(rng, ".mcap")


FORMATS = {
    "csv": csv_file,
    "parquet": parquet_file,
    "npy": array_file,
    "motive": motive_file,
    "kept": kept_file,
    "mcap": mcap_file,
}


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a file in one to four places."""
    for _ in range(rng.integers(1, 5)):
        content = bytearray(data)
        place = int(rng.integers(len(content))) if content else 0
        # Half of the damage is near the beginning, where headings are.
        place = place if rng.random() < 0.5 else place % 400
        kind = rng.integers(9)
        if kind == 0 and content:
            content[min(place, len(content) - 1)] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            content[place : place + int(rng.integers(1, 20))] = b""
        elif kind == 2:
            content[place:place] = rng.bytes(int(rng.integers(1, 20)))
        elif kind == 3:
            content = content[:place]
        elif kind == 4:
            piece = content[place : place + int(rng.integers(1, 200))]
            content[place:place] = piece
        elif kind == 5:
            content = bytearray(
                bytes(content).replace(b",", _SEPARATORS[rng.integers(len(_SEPARATORS))], 1 + 9 * place)
            )
        else:
            lines = bytes(content).split(b"\n")
            line = int(rng.integers(len(lines)))
            cells = lines[line].split(b",")
            if kind == 6:
                cells[rng.integers(len(cells))] = _ABSURD[rng.integers(len(_ABSURD))]
                lines[line] = b",".join(cells)
            elif kind == 7:
                rng.shuffle(cells)
                lines[line] = b",".join(cells)
            else:
                lines.insert(int(rng.integers(len(lines))), lines.pop(line))
            content = bytearray(b"\n".join(lines))
        data = bytes(content)
    return data


def check(kind: str, data: bytes, folder: Path) -> bool:
    """Read a file and check that all holds; return whether it was measured."""
    path = folder / f"run.{ {'motive': 'csv', 'kept': 'parquet'}.get(kind, kind) }"
    path.write_bytes(data)
    recordings, sentence = [], ""
    try:
        recordings = read_recordings(path, rate=8.0 if kind == "npy" else None)
    except TriformError as error:
        sentence = str(error)
    assert sentence.isprintable(), "a sentence is not printable"
    assert recordings or str(path) in sentence, "a sentence does not name the file"
    for recording in recordings:
        trajectory = recording.trajectory
        poses = trajectory.poses[trajectory.active]
        assert np.isfinite(poses).all(), "a pose is not finite"
        assert (np.diff(trajectory.time) > 0).all(), "time stands still"
        assert np.abs(poses[:, 2]).max() <= np.pi + 1e-9, "a heading is beyond half a turn"
        measure(trajectory)
    return bool(recordings)


def run(rng: np.random.Generator, kind: str, folder: Path) -> bool:
    """Damage one recording and check it."""
    return check(kind, damage(FORMATS[kind](rng), rng), folder)


def main() -> int:
    """Run the campaign and return the exit status."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--tries", type=int, default=None, help="of every format, in place of seconds")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    warnings.simplefilter("error")
    tried = read = failed = 0
    end = time.monotonic() + given.seconds
    with tempfile.TemporaryDirectory() as name:
        while tried < len(FORMATS) * given.tries if given.tries else time.monotonic() < end:
            kind = list(FORMATS)[tried % len(FORMATS)]
            try:
                read += run(np.random.default_rng([given.seed, tried]), kind, Path(name))
            except Exception as error:  # noqa: BLE001
                failed += 1
                print(f"{kind}, seed [{given.seed}, {tried}]: {type(error).__name__}: {error}")
            tried += 1
    print(f"recordings: {tried} tried, {failed} failed; {read} could still be measured")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
