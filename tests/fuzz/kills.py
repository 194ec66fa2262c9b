"""Writers that are killed at any moment: what they wrote is the old or the new, never a mixture.

    python -m tests.fuzz.kills --tries 500 --seed 0

Each trial starts a process that saves two policies in turn into one folder, or exports them in place, or writes one
file, and kills it with SIGKILL after a random time. Systems without ``fork`` cannot run it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import torch

from tests.fuzz.trials import campaign, options
from triform.files import sha256, write_atomically
from triform.policy import NetworkConfig, PolicyRuntime, PolicySpec, pack
from triform.policy.checkpoint import read_exported, read_weights
from triform.policy.export import export_policy
from triform.policy.vit import VisionTransformer
from triform.policy.weights import load_policy, save_policy
from triform.types import MapConfig, ScanConfig, TriformError

#: Longest time before a process is killed [s]; a save takes about a millisecond, an export about thirty.
_LONGEST = 0.06
_SPEC = PolicySpec(
    NetworkConfig(map_size=20, patch=5, dim=16, depth=1, heads=2, mlp=16),
    ScanConfig(),
    MapConfig(size=20, cell=0.2, max_cells=50),
)
_MAPS = (np.random.default_rng(0).random((3, 20, 20)) < 0.05).astype(np.uint8)


def _networks() -> list[tuple[VisionTransformer, PolicySpec]]:
    """Two policies of unlike weights, told apart by their ``rest_speed`` too."""
    found = []
    for seed in range(2):
        torch.manual_seed(seed)
        found.append((VisionTransformer(_SPEC.network).eval(), replace(_SPEC, rest_speed=0.01 * seed)))
    return found


class Kills:
    """Trials in one folder, in which leftovers of earlier kills stay."""

    def __init__(self, folder: Path) -> None:
        """Begin with a whole policy and a whole file."""
        self.policy, self.file = folder / "policy", folder / "file"
        self.networks = _networks()
        save_policy(self.policy, *self.networks[0])
        self.weights = []
        for network, spec in self.networks:
            save_policy(folder / "each", network, spec)
            self.weights.append(sha256(read_weights(folder / "each")[1]))
        self.contents = [bytes([number]) * 200_000 for number in range(2)]
        write_atomically(self.file, self.contents[0])

    def saves(self) -> None:
        """Save the two policies in turn."""
        for number in count():
            save_policy(self.policy, *self.networks[number % 2])

    def exports(self) -> None:
        """Save the two policies in turn, and export each in place."""
        for number in count():
            save_policy(self.policy, *self.networks[number % 2])
            export_policy(self.policy, _MAPS)

    def writes(self) -> None:
        """Write one file in turn."""
        for number in count():
            write_atomically(self.file, self.contents[number % 2])

    def torn(self) -> str:
        """What is not whole now."""
        if self.file.read_bytes() not in self.contents:
            return "half a file"
        try:
            _, spec = load_policy(self.policy)
            if self.weights[round(100 * spec.rest_speed)] != spec.weights_sha256:
                return "the weights of one policy with the description of the other"
            if spec.onnx_sha256:
                read_exported(self.policy)
                PolicyRuntime(self.policy).commands(pack(_MAPS, 5))
        except TriformError as error:
            return str(error)
        return ""

    def trial(self, rng: np.random.Generator) -> str:
        """Kill one process."""
        work: Callable[[], None] = (self.saves, self.exports, self.writes)[rng.choice(3, p=[0.4, 0.4, 0.2])]
        child = multiprocessing.get_context("fork").Process(target=work)
        child.start()
        time.sleep(rng.random() * _LONGEST)
        assert child.pid is not None
        os.kill(child.pid, signal.SIGKILL)
        child.join()
        found = self.torn()
        if not found and child.exitcode != -signal.SIGKILL:
            found = f"the process ended by itself with {child.exitcode}"
        return f"{work.__name__}: {found}" if found else ""

    def left(self) -> list[str]:
        """Files that nothing names once each writer has finished once more."""
        network, spec = self.networks[0]
        save_policy(self.policy, network, spec)
        write_atomically(self.file, self.contents[0])
        known = {"model.json", f"model-{self.weights[0][:16]}.safetensors"}
        return [*{path.name for path in self.policy.iterdir()} - known, *map(str, self.file.parent.glob(".*"))]


def run(tries: int, seconds: float = np.inf, seed: int = 0) -> int:
    """Kill ``tries`` writers; returns those that left something torn or useless."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with tempfile.TemporaryDirectory() as folder:
            kills = Kills(Path(folder))
            failed = campaign("kills", kills.trial, tries, seconds, seed)
            left = kills.left()
            if left:
                print("left behind:", *left)
            return failed + len(left)
    finally:
        torch.set_num_threads(threads)


if __name__ == "__main__":
    given = options(__doc__ or "", tries=500)
    sys.exit(run(given.tries, given.seconds, given.seed) > 0)
