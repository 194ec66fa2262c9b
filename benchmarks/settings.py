"""How thoroughly to measure, and how a group says what it is at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """How to measure.

    Attributes:
        quick: Tiny sizes and few rounds: shows that everything works, and measures nothing well.
        cores: Processors that the measurements may use; they are pinned to the first ones.
    """

    quick: bool = False
    cores: int = 2

    @property
    def rounds(self) -> int:
        """Turns of each side of a comparison."""
        return 3 if self.quick else 15

    @property
    def slice_seconds(self) -> float:
        """Time that one turn should take at least [s]."""
        return 0.005 if self.quick else 0.2

    @property
    def training_rounds(self) -> int:
        """Turns of each side where a side trains."""
        return 2 if self.quick else 7

    @property
    def training_steps(self) -> int:
        """Steps of the paper's network in one turn of its training."""
        return 3 if self.quick else 40

    @property
    def training_warm_up(self) -> int:
        """Steps before a turn of training counts; new shapes of mini-batches are slower the first time."""
        return 5 if self.quick else 100

    @property
    def thread_counts(self) -> tuple[int, ...]:
        """Numbers of threads to show: one, and all."""
        return tuple(sorted({1, self.cores}))


#: Told what is being measured, the turns done and the turns in all.
Watch = Callable[[str, int, int], None]
