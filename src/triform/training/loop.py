"""The training loop, from top to bottom."""

from __future__ import annotations

import json
import math
import signal
from collections.abc import Callable
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from triform.control import weights_folder
from triform.control.triangulating_kernels import LAW_FEATURES
from triform.files import exclusive, make_folder, write_atomically
from triform.policy import describe_network
from triform.policy.kinds import make_network
from triform.signals import StopSignals
from triform.training.auxiliary import TARGETS, AuxiliaryHead, feature_loss, token_loss
from triform.training.batches import DeviceBatch, SceneSource, TrainBatch, open_source
from triform.training.checkpoints import STATE_FILE, Checkpoints, Progress
from triform.training.dagger import collect_states
from triform.training.flat import FlatParameters
from triform.training.precision import matrix_products, reduced
from triform.training.prefetch import Prefetched
from triform.training.presets import TrainConfig
from triform.training.processes import Processes, joined, local_device
from triform.training.start import begin_from
from triform.training.state import load_state
from triform.types import TriformError, require

CONFIG_FILE = "train.json"


def command_loss(predicted: Tensor, wanted: Tensor, kind: str) -> Tensor:
    """Losses of commands summed over maps: Euclidean norm of the error, or its mean square.

    Args:
        predicted: Body twists and, behind them, amplitudes of pushes if there are any, shape (M, outputs).
        wanted: The same of the teacher.
        kind: ``norm`` or ``mse``. With the norm, the error of an amplitude counts by itself.
    """
    squares = (predicted - wanted).square()
    if kind == "mse":
        return squares.mean(1).sum()
    # The small constant keeps the gradient finite at zero error.
    return (squares[:, :3].sum(1) + 1e-8).sqrt().sum() + (squares[:, 3:] + 1e-8).sqrt().sum()


def learning_rate(config: TrainConfig, step: int, steps: int) -> float:
    """Learning rate of a step: linear warm-up, then cosine to zero or constant."""
    warm = min(1.0, (step + 1) / config.warmup) if config.warmup else 1.0
    decay = 0.5 * (1 + math.cos(math.pi * step / steps)) if config.schedule == "cosine" else 1.0
    return config.learning_rate * warm * decay


class Learner(nn.Module):
    """The policy and, while training, the auxiliary head."""

    def __init__(self, config: TrainConfig) -> None:
        super().__init__()
        self.policy = make_network(config.network)
        network, wanted = config.network, config.auxiliary > 0
        self.auxiliary = AuxiliaryHead(network.token_width, TARGETS) if wanted else None
        self.facts = AuxiliaryHead(network.dim, LAW_FEATURES) if wanted and config.scenes is not None else None

    def losses(self, batch: DeviceBatch, config: TrainConfig, maps: float, tokens: float) -> tuple[Tensor, Tensor]:
        """Command loss and total loss of a mini-batch: sums over what it holds, over the numbers to divide by.

        Args:
            batch: The mini-batch, or the share of it that falls to this process.
            config: What is trained.
            maps: Maps of the whole mini-batch.
            tokens: Tokens with targets in the whole mini-batch.
        """
        with reduced(config.precision, batch.commands.device):
            token_features, features = self.policy.encode(batch.inputs)
            commands = self.policy.command(features)[: len(batch.commands)]
            predicted = self.auxiliary(token_features) if self.auxiliary is not None else None
            told = self.facts(features)[: len(batch.commands)] if self.facts is not None else None
        command = command_loss(commands.float(), batch.commands, config.loss) / maps
        total = command
        if predicted is not None:
            total = total + config.auxiliary * token_loss(predicted.float(), batch.targets, batch.valid) / tokens
        if told is not None:
            total = total + config.auxiliary * feature_loss(told.float(), batch.features) / maps
        return command, total


def make_optimizer(config: TrainConfig, parameters: FlatParameters) -> torch.optim.Optimizer:
    """The optimiser that a configuration names."""
    if config.optimizer == "rmsprop":
        return torch.optim.RMSprop([parameters.values], lr=config.learning_rate)
    return torch.optim.AdamW([parameters.values], lr=config.learning_rate, weight_decay=config.weight_decay, fused=True)


def _check_same_run(out: Path, config: TrainConfig, data: str | None, resume: bool) -> None:
    """Refuse to overwrite another run or to continue one with other settings; record the settings."""
    path = out / CONFIG_FILE
    parts = {"network": describe_network(config.network), "scan": vars(config.scan), "map": vars(config.map)}
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
    producers: int | None = None,
    report: Callable[[Progress], None] = lambda _: None,
    save_seconds: float = 60.0,
) -> Path:
    """Train a policy; killed at any moment, it continues exactly where its last saved state was.

    Under ``torchrun`` several processes train one policy: each takes its share of every mini-batch, and gradients
    are those of the whole. The first process alone writes and reports; all must see ``out`` and ``data``.

    Args:
        config: What to train and how.
        out: Folder for state, logs and the best and last policy.
        data: Stored demonstrations; fresh ones are drawn if ``None``.
        resume: Continue the run in ``out``, with as many processes as you like.
        device: PyTorch device; of ``cuda``, each process of a machine takes one.
        producers: Threads that make mini-batches ahead of time; by default one on the CPU and four for a GPU.
        report: Called after every step.
        save_seconds: Time between two saved states [s].

    Returns:
        Folder of the best policy.

    Raises:
        TriformError: If a folder, the data or the device do not fit, another process is lost, or the loss stops being
            finite.
        KeyboardInterrupt: After Ctrl-C or SIGTERM, once the step under way is done and saved.
    """
    target = usable_device(local_device(device))
    if producers is None:
        producers = 1 if target.type == "cpu" else 4
    require(producers >= 1, f"producers is {producers}; it must be at least 1")
    with joined(target) as processes, matrix_products(config.precision), ExitStack() as held:
        source = open_source(config, data)
        torch.manual_seed(config.seed)
        learner = Learner(config)
        if config.start is not None:
            begin_from(weights_folder(config.start), learner.policy, config.map)
        if processes.first:
            make_folder(out)
            held.enter_context(exclusive(out))
            _check_same_run(out, config, source.checksum, resume)
        processes.wait()
        learner.to(target)
        parameters = FlatParameters(learner)
        optimizer = make_optimizer(config, parameters)
        record: dict[str, Any] = {"step": 0, "maps": 0, "loss": math.nan, "best": math.inf}
        if resume and (out / STATE_FILE).exists():
            record = load_state(out / STATE_FILE, learner, optimizer)
        signals = held.enter_context(StopSignals(always=(), unless_ignored=(signal.SIGINT, signal.SIGTERM)))
        checkpoints = None
        if isinstance(source, SceneSource):
            # Validation draws from the teacher's states too.
            source.visited = collect_states(out, config, learner.policy, 0, processes)
        if processes.first:
            policy = learner.policy
            checkpoints = Checkpoints(out, config, source, learner, policy, optimizer, record, report, save_seconds)
            held.enter_context(checkpoints)
        # Nobody writes a state that another has yet to read.
        processes.wait()
        bounds = config.round_steps(source.steps)
        for number, (begin, end) in enumerate(pairwise(bounds)):
            if end <= record["step"]:
                continue
            if isinstance(source, SceneSource):
                source.visited = collect_states(out, config, learner.policy, number, processes)
            first = max(begin, record["step"])
            prefetched = Prefetched(source.batches(first, processes), producers)
            with prefetched as batches:
                for step in range(first, end):
                    batch = next(batches)
                    shared = torch.tensor([batch.valid.sum(), signals.received], dtype=torch.float64)
                    processes.add(shared)
                    tokens, stops = shared.tolist()
                    loss, norm = _gradient(learner, parameters, processes, batch, config, max(tokens, 1.0))
                    # Before the step, so that weights that are not finite are never kept.
                    if not math.isfinite(loss + norm):
                        raise TriformError(
                            f"training diverged at step {step + 1}: the loss is {loss}, its gradient's norm {norm}"
                        )
                    for group in optimizer.param_groups:
                        group["lr"] = learning_rate(config, step, source.steps)
                    optimizer.step()
                    stop = stops > 0 and step + 1 < source.steps
                    if checkpoints is not None:
                        # A round begins from a saved state, so that it can be repeated.
                        checkpoints.enter(loss, batch.maps, prefetched.waited, save=stop or step + 1 in bounds)
                    if stop:
                        raise KeyboardInterrupt
    return out / "best"


def _gradient(
    learner: Learner,
    parameters: FlatParameters,
    processes: Processes,
    batch: TrainBatch,
    config: TrainConfig,
    tokens: float,
) -> tuple[float, float]:
    """Take the clipped gradient of a whole mini-batch; return its command loss and the norm before clipping."""
    parameters.gradient.zero_()
    here = batch.to(parameters.gradient.device)
    command, total = learner.losses(here, config, batch.maps, tokens)
    torch.autograd.backward(total)
    parameters.gradient[-1] = command.detach()
    processes.add(parameters.gradient)
    norm = parameters.clip(config.clip)
    loss, size = torch.stack([parameters.gradient[-1], norm]).tolist()
    return loss, size
