"""``triform train``: a policy, trained."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

from rich.console import Console

from triform.commands.terminal import Terminal, given_options, maps_progress
from triform.limits import LARGEST_SEED, check_threads, require_at_most
from triform.types import convert_fields


@dataclass(frozen=True)
class Train:
    """Options of ``triform train``.

    Attributes:
        out: Folder for state, logs and the best and last policy.
        preset: ``default`` learns the triangulating law, ``quick`` so in minutes with a small network, and ``cnn``,
            ``gnn`` and ``dense`` so with other networks; ``springs`` learns an expert of springs, ``large`` so with the
            paper's network, and ``paper`` is Algorithm 1 as printed, which needs ``--data``.
        profile: Robot to train for: a name or a TOML file. Most scenes have its outline, rays are as many as its
            LiDAR's, and errors at least as large. If omitted, most scenes have a RoboMaster EP.
        data: Folder of stored demonstrations; fresh ones are drawn if omitted.
        maps: Maps to train on. The preset's if omitted.
        teacher: Who labels: ``expert``, ``expert-sensed`` or ``expert-odd``. The data set's or the
            preset's if omitted.
        rounds: Shares of the training after which the learner itself drives teams. The preset's if omitted.
        learning_rate: Peak learning rate. The preset's if omitted.
        seed: Seed of weights and data. The preset's if omitted.
        start: Weights to begin from instead of random ones: a shipped policy's name or a folder, with the preset's
            network. Its map may see less far.
        precision: Arithmetic of matrix products: ``float32``, ``medium`` (whichever float32 PyTorch computes fastest)
            or ``bfloat16``. The preset's if omitted.
        device: PyTorch device, such as ``cpu`` or ``cuda``.
        threads: Threads of PyTorch on the CPU.
        producers: Threads that make mini-batches ahead of time; one on the CPU and four for a GPU if omitted.
        resume: Continue the run in ``out`` exactly where it stopped.
    """

    out: Path
    preset: Literal["default", "near", "quick", "springs", "large", "paper", "cnn", "gnn", "dense"] = "default"
    profile: str | None = None
    data: Path | None = None
    maps: int | None = None
    teacher: str | None = None
    rounds: tuple[float, ...] | None = None
    learning_rate: float | None = None
    seed: int | None = None
    start: str | None = None
    precision: Literal["float32", "medium", "bfloat16"] | None = None
    device: str = "cpu"
    threads: int = 1
    producers: int | None = None
    resume: bool = False

    GROUPS: ClassVar[dict[str, tuple[str, ...]]] = {
        "recipe": ("maps", "teacher", "rounds", "learning_rate", "seed", "start", "precision"),
        "machine": ("device", "threads", "producers"),
    }

    def __post_init__(self) -> None:
        convert_fields(self)
        check_threads(self.threads)
        require_at_most("seed", self.seed, LARGEST_SEED)
        for name, most in (("maps", 10**12), ("producers", 4096)):
            require_at_most(name, getattr(self, name), most)

    def run(self, console: Console) -> None:
        """Train, with progress, which only the first of several processes shows."""
        import torch

        from triform.dataset import load_manifest
        from triform.simulation import get_profile
        from triform.training import PRESETS, train
        from triform.training.processes import launched

        if not launched().first:
            console = Console(quiet=True)
        torch.set_num_threads(self.threads)
        preset = PRESETS[self.preset]
        given = given_options(self, "maps", "teacher", "rounds", "learning_rate", "seed", "start", "precision")
        if self.data is not None and self.teacher is None and preset.scenes is None:
            given["teacher"] = load_manifest(self.data).config.teacher
        config = replace(preset, **given)
        if self.profile is not None:
            config = config.for_robot(get_profile(self.profile))
        with maps_progress(console) as update:
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
        terminal = Terminal(console)
        for line in (
            f"best policy: {best}; to use it:",
            f"triform export {best}",
            f"triform evaluate --controller policy:{best}",
        ):
            terminal.say(line)
