"""``triform collect``: demonstrations, stored."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

from rich.console import Console

from triform.commands.terminal import Terminal, given_options, maps_progress
from triform.engines import EngineName, open_engine
from triform.experiments.settings import warn_of_time
from triform.limits import LARGEST_SEED, require_at_most, require_memory
from triform.types import convert_fields

#: Of one shard in memory, and of one worker; both are those of the presets.
_BYTES_PER_MAP, _MAPS_PER_SECOND = 500.0, 20_000


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

    GROUPS: ClassVar[dict[str, tuple[str, ...]]] = {
        "recipe": ("teacher", "seed", "runs", "steps", "placements"),
        "execution": ("workers", "engine", "ray_address"),
    }

    def __post_init__(self) -> None:
        convert_fields(self)
        require_at_most("seed", self.seed, LARGEST_SEED)
        for name, most in (("runs", 10**6), ("steps", 10**6), ("placements", 10**8), ("workers", 4096)):
            require_at_most(name, getattr(self, name), most)

    def run(self, console: Console) -> None:
        """Collect, with progress."""
        from triform.dataset import PRESETS, collect

        given = given_options(self, "teacher", "seed", "runs", "steps", "placements")
        config = replace(PRESETS[self.preset], **given)
        require_memory(
            _BYTES_PER_MAP * config.shard_runs * config.steps * config.robots,
            f"a shard of roll-outs of {config.steps:,} steps",
        )
        warn_of_time(config.maps, self.workers, Terminal(console), _MAPS_PER_SECOND)
        began: tuple[float, int] | None = None
        with open_engine(self.engine, self.workers, self.ray_address) as engine, maps_progress(console) as update:

            def show(done: int, total: int) -> None:
                nonlocal began
                now = time.monotonic()
                began = began or (now, done)
                rate = (done - began[1]) / max(now - began[0], 1e-3)
                update(description="collecting", completed=done, total=total, rate=rate)

            manifest = collect(self.out, config, progress=show, engine=engine)
        size = sum(shard.bytes for shard in manifest.shards) / 1e6
        Terminal(console).say(
            f"{config.maps:,} maps in {len(manifest.shards)} shards, {size:,.1f} MB, in {self.out}",
        )
