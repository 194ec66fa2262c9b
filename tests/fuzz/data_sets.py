"""Damaged and absurd data sets: read as they were collected, or refused in a sentence.

python -m tests.fuzz.data_sets --tries 2000 --seed 0
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz.policies import spoil
from tests.fuzz.trials import campaign, flip, options
from triform.dataset import CollectionConfig, Demonstrations, collect
from triform.decode import checksum
from triform.engines import LocalEngine
from triform.types import TriformError

SMALL = CollectionConfig(
    robots=3, runs=3, steps=9, placements=10, block_placements=5, shard_runs=2, group_records=4, validation_share=0.4
)
#: What belongs to the form of a manifest and not to what it says.
_FORM = ("format", "format_version", "sha256")


class DataSets:
    """Trials on one small data set."""

    def __init__(self, folder: Path) -> None:
        """Collect it."""
        collect(folder, SMALL, engine=LocalEngine(1))
        self.folder, self.manifest = folder, folder / "manifest.json"
        self.files = [self.manifest, *sorted((folder / "shards").iterdir())]
        self.text = self.manifest.read_bytes()
        self.values = json.loads(self.text)
        self.whole = self.read()

    def read(self) -> list[bytes]:
        """All that a training would get of it."""
        opened = Demonstrations.open(self.folder)
        described = repr(opened.manifest.config).encode()
        batches = [batch for split in ("train", "validation") for batch in opened.batches(split, 5)]  # type: ignore[arg-type]
        return [described, *(each.maps().tobytes() + each.commands.tobytes() for each in batches)]

    def damage(self, rng: np.random.Generator) -> None:
        """Flip a bit of the manifest or of a shard, or cut or lengthen it."""
        path = self.files[0] if rng.random() < 0.6 else self.files[rng.integers(1, len(self.files))]
        data, kind = path.read_bytes(), rng.random()
        if kind < 0.8:
            path.write_bytes(flip(data, rng))
        else:
            path.write_bytes(data[: rng.integers(len(data))] if kind < 0.9 else data + rng.bytes(rng.integers(1, 9)))

    def absurd(self, rng: np.random.Generator) -> None:
        """Write absurd values into the manifest, signed or as of a version without checksum."""
        values = spoil({key: each for key, each in self.values.items() if key not in _FORM}, rng)
        head: dict[str, Any] = {"format": self.values["format"], "format_version": 1}
        if rng.random() < 0.5:
            head |= {"format_version": 2, "sha256": checksum(values)}
        text = json.dumps(head | values).encode()
        self.manifest.write_bytes(text if rng.random() < 0.98 else 100_000 * rng.choice([b"[", b'{"a":']))

    def trial(self, rng: np.random.Generator) -> str:
        """Damage the data set, read it, and mend it."""
        kept = {path: path.read_bytes() for path in self.files}
        signed = rng.random() < 0.4
        (self.absurd if signed else self.damage)(rng)
        try:
            read = self.read()
        except TriformError as error:
            return "" if len(str(error).splitlines()) == 1 else f"several lines: {error!r}"
        except Exception as error:  # noqa: BLE001 - what is looked for
            return f"{type(error).__name__}: {error}"
        finally:
            changed = [path.read_bytes() for path in self.files if path.read_bytes() != kept[path]]
            for path, data in kept.items():
                path.write_bytes(data)
        # Who signs other values, such as another gain, says something else and is believed.
        return "" if signed or read == self.whole else f"accepted with another meaning: {changed[0][:3000]!r}"


def run(tries: int, seconds: float = np.inf, seed: int = 0) -> int:
    """Try ``tries`` damaged data sets; returns those that failed."""
    with tempfile.TemporaryDirectory() as folder:
        return campaign("data sets", DataSets(Path(folder)).trial, tries, seconds, seed)


if __name__ == "__main__":
    given = options(__doc__ or "", tries=2000)
    sys.exit(run(given.tries, given.seconds, given.seed) > 0)
