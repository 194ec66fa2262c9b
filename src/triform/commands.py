"""Commands that have no room of their own: their options, and the call that each makes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from triform.engines import EngineName, open_engine
from triform.types import ConfigurationError

#: Robots in fresh states for which an exported policy is compared with PyTorch, at least.
_CHECKED_ROBOTS = 1000


@dataclass(frozen=True)
class Collect:
    """Options of ``triform collect``.

    Attributes:
        out: Folder of the data set; a collection that was stopped there is finished.
        preset: ``paper`` is the paper's 600 x 1000 records plus 400,000 placements, ``quick`` takes seconds.
        teacher: Who demonstrates: ``expert`` sees everybody, ``expert-sensed`` 2 m, ``expert-odd`` has odd springs.
            The preset's if omitted.
        seed: Seed of everything random. The preset's if omitted.
        runs: Roll-outs. The preset's if omitted.
        steps: Records of one roll-out. The preset's if omitted.
        placements: Random placements. The preset's if omitted.
        workers: Shards collected side by side; one for each processor if omitted.
        engine: Where: local is this process, ray is Ray, on this machine or a cluster. The data set is the same.
        ray_address: Ray cluster to use, host:port or auto; Ray is started on this machine if omitted.
    """

    out: Path
    preset: Literal["paper", "quick"] = "quick"
    teacher: str | None = None
    seed: int | None = None
    runs: int | None = None
    steps: int | None = None
    placements: int | None = None
    workers: int | None = None
    engine: EngineName = "local"
    ray_address: str | None = None

    def run(self, console: Console) -> None:
        """Collect, with progress."""
        from triform.dataset import PRESETS, collect

        given = _given(self, "teacher", "seed", "runs", "steps", "placements")
        config = replace(PRESETS[self.preset], **given)
        began: tuple[float, int] | None = None
        with open_engine(self.engine, self.workers, self.ray_address) as engine, _progress(console) as update:

            def show(done: int, total: int) -> None:
                nonlocal began
                now = time.monotonic()
                began = began or (now, done)
                rate = (done - began[1]) / max(now - began[0], 1e-3)
                update(description="collecting", completed=done, total=total, rate=rate)

            manifest = collect(self.out, config, progress=show, engine=engine)
        size = sum(shard.bytes for shard in manifest.shards) / 1e6
        console.print(
            f"{config.maps:,} maps in {len(manifest.shards)} shards, {size:,.1f} MB, in {self.out}",
            soft_wrap=True,
            markup=False,
        )


@dataclass(frozen=True)
class Train:
    """Options of ``triform train``.

    Attributes:
        out: Folder for state, logs and the best and last policy.
        preset: ``default`` learns the triangulating law, and ``cnn``, ``gnn`` and ``dense`` do so with other networks;
            ``springs`` learns an expert of springs, ``large`` so with the paper's network, and ``paper`` is Algorithm 1
            as printed, which needs ``--data``.
        data: Stored demonstrations; fresh ones are drawn if omitted.
        maps: Maps to train on. The preset's if omitted.
        teacher: Who labels: ``expert``, ``expert-sensed`` or ``expert-odd``. The data set's or the
            preset's if omitted.
        rounds: Shares of the training after which the learner itself drives teams. The preset's if omitted.
        learning_rate: Peak learning rate. The preset's if omitted.
        seed: Seed of weights and data. The preset's if omitted.
        precision: Arithmetic of matrix products: ``float32``, ``medium`` (whichever float32 PyTorch computes fastest)
            or ``bfloat16``. The preset's if omitted.
        device: PyTorch device, such as ``cpu`` or ``cuda``.
        threads: Threads of PyTorch on the CPU.
        producers: Threads that make mini-batches ahead of time; one on the CPU and four for a GPU if omitted.
        resume: Continue the run in ``out`` exactly where it stopped.
    """

    out: Path
    preset: Literal["default", "springs", "large", "paper", "cnn", "gnn", "dense"] = "default"
    data: Path | None = None
    maps: int | None = None
    teacher: str | None = None
    rounds: tuple[float, ...] | None = None
    learning_rate: float | None = None
    seed: int | None = None
    precision: Literal["float32", "medium", "bfloat16"] | None = None
    device: str = "cpu"
    threads: int = 1
    producers: int | None = None
    resume: bool = False

    def run(self, console: Console) -> None:
        """Train, with progress, which only the first of several processes shows."""
        import torch

        from triform.dataset import load_manifest
        from triform.training import get_preset, train
        from triform.training.processes import launched

        if not launched().first:
            console = Console(quiet=True)
        if self.threads < 1:
            raise ConfigurationError(f"threads is {self.threads}; it must be at least 1")
        torch.set_num_threads(self.threads)
        preset, given = (
            get_preset(self.preset),
            _given(self, "maps", "teacher", "rounds", "learning_rate", "seed", "precision"),
        )
        if self.data is not None and self.teacher is None and preset.scenes is None:
            given["teacher"] = load_manifest(self.data).config.teacher
        config = replace(preset, **given)
        with _progress(console) as update:
            best = train(
                config,
                self.out,
                data=self.data,
                resume=self.resume,
                device=self.device,
                producers=self.producers,
                report=lambda at: update(
                    completed=at.step,
                    total=at.steps,
                    rate=at.maps_per_second,
                    description=f"training, loss {at.loss:.4f}",
                ),
            )
        console.print(
            f"best policy: {best}; to use it:\ntriform export {best}\ntriform evaluate --weights {best}",
            soft_wrap=True,
            markup=False,
        )


@dataclass(frozen=True)
class Export:
    """Options of ``triform export``.

    Attributes:
        folder: Folder of a policy; ``model.onnx`` is written into it.
        precision: Numbers of the linear layers. ``int8`` is faster and less exact.
        out: Another folder for the exported policy.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    precision: Literal["float32", "int8"] = "float32"
    out: Path | None = None

    def run(self, console: Console) -> None:
        """Export, check in fresh states and say how well it went."""
        import numpy as np

        from triform.dataset import fresh_inputs
        from triform.policy import read_spec
        from triform.policy.checkpoint import ONNX_FILE
        from triform.policy.export import export_policy

        spec = read_spec(self.folder)
        difference = export_policy(
            self.folder, fresh_inputs(np.random.default_rng(0), _CHECKED_ROBOTS, spec), self.precision, self.out
        )
        console.print(
            f"wrote {(self.out or self.folder) / ONNX_FILE} in {self.precision}; in fresh states of {_CHECKED_ROBOTS} "
            f"robots its commands differ from PyTorch's by {difference.mean:.0e} on average and "
            f"{difference.largest:.0e} at most",
            soft_wrap=True,
            markup=False,
        )


def _given(options: Collect | Train, *names: str) -> dict[str, Any]:
    """The options among ``names`` that were given; the preset decides the others."""
    return {name: getattr(options, name) for name in names if getattr(options, name) is not None}


@contextmanager
def _progress(console: Console) -> Iterator[Callable[..., None]]:
    """Give a function that updates a bar with the rate of the work and the time left.

    The bar appears with the first update, so that a refusal before the work stands alone.
    """
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TextColumn("{task.fields[rate]:,.0f} maps/s"),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=console,
    )
    task = bar.add_task("", total=None, rate=0.0)

    def update(**fields: Any) -> None:
        bar.start()
        bar.update(task, **fields)

    try:
        yield update
    finally:
        if bar.live.is_started:
            bar.stop()
