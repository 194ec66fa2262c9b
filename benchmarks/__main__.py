"""Command line: ``python -m benchmarks``."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from benchmarks.groups import GROUPS
from benchmarks.runner import run
from benchmarks.settings import Settings
from triform.types import TriformError, require


@dataclass(frozen=True)
class Options:
    """Measure triform, its peers and the machine, and write the tables ``bench.md`` and ``bench.json``.

    Attributes:
        only: Groups to measure; all if omitted.
        quick: Tiny sizes and few turns: shows that everything works, and measures nothing well.
        cores: Processors to use. The aims are stated for two.
        output: Folder of the tables.
    """

    only: tuple[str, ...] = ()
    quick: bool = False
    cores: int = 2
    output: Path = Path("benchmarks/results")

    def __post_init__(self) -> None:
        unknown = sorted(set(self.only) - set(GROUPS))
        require(not unknown, f"there is no group {', '.join(unknown)}; the groups are {', '.join(GROUPS)}")
        usable = len(os.sched_getaffinity(0))
        require(1 <= self.cores <= usable, f"cores is {self.cores}; this process may use 1 to {usable}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and return the exit status: 1 if a group failed."""
    try:
        options = tyro.cli(Options, prog="python -m benchmarks", args=arguments)
        console = Console(stderr=True)
        groups = [GROUPS[name] for name in options.only or GROUPS]
        results = run(groups, Settings(options.quick, options.cores), options.output, console)
    except TriformError as error:
        sys.stderr.write(f"benchmarks: {error}\n")
        return 1
    console.print(f"wrote {options.output / 'bench.md'} and bench.json", markup=False, soft_wrap=True)
    return int(any(result.failure for result in results))


if __name__ == "__main__":
    sys.exit(main())
