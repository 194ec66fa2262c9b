"""What a training leaves behind while it runs: its log, its saved state, and the best and last policy."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from triform.policy.network import PolicyNetwork
from triform.policy.weights import save_policy
from triform.training.batches import Source, TrainBatch
from triform.training.logs import TrainingLog
from triform.training.presets import TrainConfig
from triform.training.state import save_state
from triform.types import TriformError

STATE_FILE = "state.safetensors"


@dataclass(frozen=True)
class Progress:
    """What the loop reports while it runs.

    Attributes:
        step: Steps done.
        steps: Steps to do.
        maps: Maps seen.
        maps_per_second: Rate since the start or resumption.
        loss: Mean command loss of the last steps.
    """

    step: int
    steps: int
    maps: int
    maps_per_second: float
    loss: float


@torch.no_grad()
def validate(policy: PolicyNetwork, batches: list[TrainBatch]) -> dict[str, float]:
    """Command errors [m/s] on fixed demonstrations: their mean norm, and the median where little is commanded.

    States with a command below 0.1 m/s are near equilibrium; the error there is what limits the formation error.
    """
    device = next(policy.parameters()).device
    errors, sizes = [], []
    for batch in batches:
        here = batch.to(device)
        errors.append((policy(here.inputs)[: len(here.commands)] - here.commands).norm(dim=1))
        sizes.append(here.commands.norm(dim=1))
    error, small = torch.cat(errors), torch.cat(sizes) < 0.1
    return {
        "error_mean": float(error.mean()),
        "error_median_settled": float(error[small].median()) if bool(small.any()) else math.nan,
    }


class Checkpoints:
    """Keeps the books of a training; use as a context manager."""

    def __init__(
        self,
        out: Path,
        config: TrainConfig,
        source: Source,
        learner: nn.Module,
        policy: PolicyNetwork,
        optimizer: torch.optim.Optimizer,
        record: dict[str, Any],
        report: Callable[[Progress], None],
        save_seconds: float,
    ) -> None:
        """Open them.

        Args:
            out: Folder for everything.
            config: What is trained.
            source: Where demonstrations come from.
            learner: What is trained, ``policy`` included.
            policy: What is kept in the end.
            optimizer: Its optimiser.
            record: What a saved state says of the progress so far.
            report: Called after every step.
            save_seconds: Time between two saved states [s].
        """
        self._out = out
        self._spec = config.spec()
        self._steps = source.steps
        self._validate_every, self._log_every = max(1, self._steps // 50), max(1, self._steps // 1000)
        self._checks = source.validation()
        self._learner, self._policy, self._optimizer = learner, policy, optimizer
        self._record = dict(record)
        self._report, self._save_seconds = report, save_seconds
        self._log = TrainingLog(out, record["step"])
        self._maps_before = record["maps"]
        self._began = self._saved = time.monotonic()

    def __enter__(self) -> Checkpoints:
        self._log.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._log.__exit__(*error)

    def enter(self, loss: float, maps: int, waited: float, *, save: bool) -> None:
        """Enter a step.

        Args:
            loss: Command loss of its mini-batch.
            maps: Maps of its mini-batch.
            waited: Time spent waiting for mini-batches since the start or resumption [s].
            save: Whether to save the state in any case.

        Raises:
            TriformError: If something cannot be written, or the network's commands are not finite.
        """
        record = self._record
        record["loss"] = loss if record["step"] == 0 else 0.98 * record["loss"] + 0.02 * loss
        record["maps"] += maps
        record["step"] += 1
        done, last = record["step"], record["step"] == self._steps
        elapsed = max(time.monotonic() - self._began, 1e-9)
        rate = (record["maps"] - self._maps_before) / elapsed
        self._report(Progress(done, self._steps, record["maps"], rate, record["loss"]))
        if done % self._log_every == 0 or last:
            speed = {"maps_per_second": rate, "share_waiting_for_data": waited / elapsed}
            self._log.write(done, {"maps": record["maps"], "loss": record["loss"], **speed})
        if done % self._validate_every == 0 or last:
            self._validate()
        if save or last or time.monotonic() - self._saved > self._save_seconds:
            save_state(self._out / STATE_FILE, self._learner, self._optimizer, record)
            self._saved = time.monotonic()

    def _validate(self) -> None:
        record = self._record
        scores = validate(self._policy, self._checks)
        if not math.isfinite(scores["error_mean"]):
            raise TriformError(f"training diverged at step {record['step']}: the network's commands are not finite")
        self._log.write(record["step"], {"maps": record["maps"], **scores})
        save_policy(self._out / "last", self._policy, self._spec)
        if scores["error_mean"] < record["best"]:
            record["best"] = scores["error_mean"]
            save_policy(self._out / "best", self._policy, self._spec)
