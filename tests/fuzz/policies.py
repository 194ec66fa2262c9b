"""Damaged and absurd policies: read as they were written, or refused in a sentence.

python -m tests.fuzz.policies --tries 20000 --seed 0
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz.trials import campaign, flip, options
from triform.control import shipped_weights
from triform.decode import checksum
from triform.policy import PolicySpec, read_spec
from triform.policy.checkpoint import graph_path, read_exported, weights_path
from triform.types import MapConfig, ScanConfig, TriformError

#: What stands in a file by mistake or by malice.
ABSURD: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 1.5, 10**9, 10**30, -(10**9), 1e30, 1e308, -0.0, 1e-320, "", "x", "1", "all", [],
    {}, [1], [0.6, 1.5], {"a": 1}, [[[[]]]], "../../elsewhere", "\0", float("nan"), float("inf"),
)  # fmt: skip


def spoil(values: Any, rng: np.random.Generator) -> Any:
    """A copy of JSON values in which one value is absurd, missing, twice there or new."""
    copy = json.loads(json.dumps(values))
    at = copy
    while True:
        keys: list[Any] = list(at) if isinstance(at, dict) else list(range(len(at)))
        if not keys:
            break
        key = keys[rng.integers(len(keys))]
        if isinstance(at[key], (dict, list)) and rng.random() < 0.8:
            at = at[key]
            continue
        kind = rng.random()
        if kind < 0.1:
            del at[key]
        elif kind < 0.2 and isinstance(at, dict):
            at[str(rng.integers(10))] = at[key]
        elif kind < 0.3 and isinstance(at[key], (int, float)) and abs(at[key]) < 1e300:
            at[key] *= float(rng.choice([-1, 1e-9, 1e3, 1e9, 1e30]))
        else:
            at[key] = ABSURD[rng.integers(len(ABSURD))]
        break
    return copy


class Policies:
    """Trials on copies of one policy."""

    def __init__(self, folder: Path, source: Path) -> None:
        """Copy the policy in ``source`` into ``folder``, to be damaged there."""
        for file in source.glob("model*"):
            shutil.copy(file, folder)
        self.folder = folder
        self.text = (folder / "model.json").read_bytes()
        self.spec = read_spec(folder)
        self.values = json.loads(self.text)

    def description(self, rng: np.random.Generator) -> str:
        """One flipped bit of the description: refused, or without a meaning."""
        text = flip(self.text, rng)
        try:
            spec = PolicySpec.from_json(text, "it")
        except TriformError as error:
            return "" if len(str(error).splitlines()) == 1 else f"several lines: {error!r}"
        return "" if spec == self.spec else f"accepted with another meaning: {text!r}"

    def contents(self, rng: np.random.Generator) -> str:
        """One flipped bit of the weights or the graph, or one cut short: refused."""
        path = (weights_path, graph_path)[rng.integers(2)](self.folder, self.spec)
        whole = path.read_bytes()
        damaged = flip(whole, rng) if rng.random() < 0.8 else whole[: rng.integers(len(whole))]
        path.write_bytes(damaged)
        try:
            read_exported(self.folder)
        except TriformError:
            return ""
        finally:
            path.write_bytes(whole)
        return f"accepted a damaged {path.name}"

    def absurd(self, rng: np.random.Generator) -> str:
        """Descriptions with absurd values, signed or of a version without checksum: refused, or within all limits."""
        values = spoil({key: each for key, each in self.values.items() if key not in ("format", "version")}, rng)
        values.pop("sha256", None)
        head: dict[str, Any] = {"format": "triform-policy", "version": 1}
        if rng.random() < 0.5:
            head |= {"version": 2, "sha256": checksum(values)}
        text = json.dumps(head | values).encode()
        if rng.random() < 0.02:
            text = 100_000 * rng.choice([b"[", b'{"a":'])
        try:
            spec = PolicySpec.from_json(text, "it")
            spec.views(ScanConfig(range_max=1e6, rays=100_000), spec.distance)
        except TriformError as error:
            return "" if len(str(error).splitlines()) == 1 else f"several lines: {error!r}"
        limits = spec.rest_speed <= 10 and 0 < spec.distance <= 1000 and isinstance(spec.map, MapConfig)
        return "" if limits else f"accepted {text!r}"

    def trial(self, rng: np.random.Generator) -> str:
        """Any of these trials; most are flipped bits of the description."""
        kind = rng.choice([self.description, self.contents, self.absurd], p=[0.8, 0.02, 0.18])
        try:
            return str(kind(rng))
        except Exception as error:  # noqa: BLE001 - what is looked for
            return f"{kind.__name__}: {type(error).__name__}: {error}"


def run(tries: int, seconds: float = np.inf, seed: int = 0, name: str = "default") -> int:
    """Try ``tries`` damaged policies; returns those that failed."""
    with tempfile.TemporaryDirectory() as folder:
        return campaign("policies", Policies(Path(folder), shipped_weights()[name]).trial, tries, seconds, seed)


if __name__ == "__main__":
    given = options(__doc__ or "", tries=20_000)
    sys.exit(run(given.tries, given.seconds, given.seed) > 0)
