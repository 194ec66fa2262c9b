"""The training loop, from top to bottom."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from triform.files import exclusive, make_folder, write_atomically
from triform.policy import PolicySpec
from triform.policy.vit import VisionTransformer, token_batch
from triform.policy.weights import save_policy
from triform.training.auxiliary import AuxiliaryHead
from triform.training.batches import FreshSource, Prefetched, StoredSource, TrainBatch, open_source
from triform.training.logs import TrainingLog
from triform.training.presets import TrainConfig
from triform.training.state import load_state, read_progress, save_state
from triform.training.stopping import stop_requests
from triform.types import TriformError

STATE_FILE = "state.safetensors"
CONFIG_FILE = "train.json"


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


def command_loss(predicted: Tensor, wanted: Tensor, kind: str) -> Tensor:
    """Loss of body twists, shape (M, 3): mean Euclidean norm of the error, or its mean square."""
    if kind == "mse":
        return (predicted - wanted).square().mean()
    # The small constant keeps the gradient finite at zero error.
    return ((predicted - wanted).square().sum(1) + 1e-8).sqrt().mean()


def learning_rate(config: TrainConfig, step: int, steps: int) -> float:
    """Learning rate of a step: linear warm-up, then cosine to zero or constant."""
    warm = min(1.0, (step + 1) / config.warmup) if config.warmup else 1.0
    decay = 0.5 * (1 + math.cos(math.pi * step / steps)) if config.schedule == "cosine" else 1.0
    return config.learning_rate * warm * decay


class Learner(nn.Module):
    """The policy and, while training, the auxiliary head."""

    def __init__(self, config: TrainConfig) -> None:
        super().__init__()
        self.policy = VisionTransformer(config.network)
        self.auxiliary = AuxiliaryHead(config.network.dim) if config.auxiliary > 0 else None

    def losses(self, batch: TrainBatch, config: TrainConfig, device: torch.device) -> tuple[Tensor, Tensor]:
        """Command loss and total loss of a mini-batch."""
        tokens = token_batch(batch.packed, device)
        # Reduced precision pays on a GPU only; losses are always taken in full precision.
        with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            token_features, class_features = self.policy.encode(tokens)
            commands = self.policy.command(class_features)
        command = command_loss(commands.float(), torch.from_numpy(batch.commands).to(device), config.loss)
        if self.auxiliary is None:
            return command, command
        targets = torch.from_numpy(batch.targets).to(device)
        valid = torch.from_numpy(batch.valid).to(device)
        return command, command + config.auxiliary * self.auxiliary.loss(token_features.float(), targets, valid)


def make_optimizer(config: TrainConfig, learner: nn.Module) -> torch.optim.Optimizer:
    """The optimiser that a configuration names."""
    if config.optimizer == "rmsprop":
        return torch.optim.RMSprop(learner.parameters(), lr=config.learning_rate)
    return torch.optim.AdamW(
        learner.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, fused=True
    )


@torch.no_grad()
def validate(learner: Learner, batches: list[TrainBatch], device: torch.device) -> dict[str, float]:
    """Command errors [m/s] on fixed demonstrations: their mean norm, and the median where little is commanded.

    States with a command below 0.1 m/s are near equilibrium; the error there is what limits the formation error.
    """
    learner.eval()
    errors, sizes = [], []
    for batch in batches:
        wanted = torch.from_numpy(batch.commands).to(device)
        errors.append((learner.policy(token_batch(batch.packed, device)) - wanted).norm(dim=1))
        sizes.append(wanted.norm(dim=1))
    learner.train()
    error, small = torch.cat(errors), torch.cat(sizes) < 0.1
    return {
        "error_mean": float(error.mean()),
        "error_median_settled": float(error[small].median()) if bool(small.any()) else math.nan,
    }


def _check_same_run(out: Path, config: TrainConfig, data: str | None, resume: bool) -> None:
    """Refuse to overwrite another run or to continue one with other settings; record the settings."""
    path = out / CONFIG_FILE
    parts = {name: vars(getattr(config, name)) for name in ("network", "scan", "map")}
    settings = {**config.record(), **parts, "data_sha256": data}
    text = json.dumps(settings, indent=2, default=list) + "\n"
    if path.exists():
        if not resume:
            raise TriformError(f"{out} already holds a training run; continue it with --resume or give another --out")
        if path.read_bytes() != text.encode():
            raise TriformError(f"{out} was trained with other settings or data (see {path}); resume with the same ones")
    elif resume:
        raise TriformError(f"{out} holds no training run to resume")
    write_atomically(path, text.encode())


def usable_device(name: str) -> torch.device:
    """The PyTorch device called ``name``.

    Raises:
        TriformError: If there is none, or this installation cannot use it.
    """
    try:
        device = torch.device(name)
        if device.type not in ("cpu", "cuda"):
            raise RuntimeError("training runs on cpu or cuda")
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise TriformError(f"PyTorch cannot use the device {name!r}: {str(error).splitlines()[0]}") from error
    return device


def train(
    config: TrainConfig,
    out: Path,
    *,
    data: Path | None = None,
    resume: bool = False,
    device: str = "cpu",
    report: Callable[[Progress], None] = lambda _: None,
    save_seconds: float = 60.0,
) -> Path:
    """Train a policy; killed at any moment, it continues exactly where its last saved state was.

    Args:
        config: What to train and how.
        out: Folder for state, logs and the best and last policy.
        data: Stored demonstrations; fresh ones are drawn if ``None``.
        resume: Continue the run in ``out``.
        device: PyTorch device.
        report: Called after every step.
        save_seconds: Time between two saved states [s].

    Returns:
        Folder of the best policy.

    Raises:
        TriformError: If a folder, the data or the device do not fit, or the loss stops being finite.
        KeyboardInterrupt: After Ctrl-C or SIGTERM, once the step under way is done and saved.
    """
    target = usable_device(device)
    source = open_source(config, data)
    make_folder(out)
    with exclusive(out):
        _check_same_run(out, config, source.checksum, resume)
        return _train(config, out, source, target, resume, report, save_seconds)


def _train(
    config: TrainConfig,
    out: Path,
    source: FreshSource | StoredSource,
    target: torch.device,
    resume: bool,
    report: Callable[[Progress], None],
    save_seconds: float,
) -> Path:
    torch.manual_seed(config.seed)
    learner = Learner(config).to(target)
    optimizer = make_optimizer(config, learner)
    record: dict[str, Any] = {"step": 0, "maps": 0, "loss": math.nan, "best": math.inf}
    state_path = out / STATE_FILE
    if resume and state_path.exists():
        load_state(state_path, learner, optimizer)
        record = read_progress(state_path)
    spec = PolicySpec(config.network, config.scan, config.map, config.distance, config.record())
    steps = source.steps
    validate_every, log_every = max(1, steps // 50), max(1, steps // 1000)
    checks = source.validation()
    began, maps_before, saved = time.monotonic(), record["maps"], time.monotonic()

    with (
        stop_requests() as stopping,
        Prefetched(source.batches(record["step"])) as batches,
        TrainingLog(out, record["step"]) as log,
    ):
        for step in range(record["step"], steps):
            batch = next(batches)
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(config, step, steps)
            command, total = learner.losses(batch, config, target)
            optimizer.zero_grad()
            torch.autograd.backward(total)
            norm = float(nn.utils.clip_grad_norm_(learner.parameters(), config.clip or math.inf))
            loss = float(command.detach())
            # Before the step, so that weights that are not finite are never kept.
            if not math.isfinite(loss + norm):
                raise TriformError(
                    f"training diverged at step {step + 1}: the loss is {loss}, its gradient's norm {norm}"
                )
            optimizer.step()

            record["loss"] = loss if step == 0 else 0.98 * record["loss"] + 0.02 * loss
            record["maps"] += len(batch.commands)
            done = step + 1
            rate = (record["maps"] - maps_before) / max(time.monotonic() - began, 1e-9)
            report(Progress(done, steps, record["maps"], rate, record["loss"]))
            if done % log_every == 0 or done == steps:
                log.write(done, {"maps": record["maps"], "loss": record["loss"], "maps_per_second": rate})
            if done % validate_every == 0 or done == steps:
                scores = validate(learner, checks, target)
                if not math.isfinite(scores["error_mean"]):
                    raise TriformError(f"training diverged at step {done}: the network's commands are not finite")
                log.write(done, {"maps": record["maps"], **scores})
                save_policy(out / "last", learner.policy, spec)
                if scores["error_mean"] < record["best"]:
                    record["best"] = scores["error_mean"]
                    save_policy(out / "best", learner.policy, spec)
            stop = stopping() and done < steps
            if stop or time.monotonic() - saved > save_seconds or done == steps:
                save_state(state_path, learner, optimizer, {**record, "step": done})
                saved = time.monotonic()
            if stop:
                raise KeyboardInterrupt
    return out / "best"
